"""Wrong and right variants of recordings, mapped by `topoloc build`: which are reported?

    python benchmarks/wrong_recordings.py [--shared ../shared] [--only TEXT] [--right] [--wrong]
        [--checks] [--json FILE]

A variant is reported if the command refuses it or warns. For one that is mapped without a word, six
of its images are localized in the map: the row has the number of answers, and their median distance
from the truth. With --checks the command ends before SLAM and mapping.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from topoloc.apps.cli import main as run_topoloc
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping import build
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.image_io import read_image
from topoloc.slam import slam
from variants.right import right_variants
from variants.walks import Walk, read_walk
from variants.wrong import Variant, wrong_variants


@dataclass(frozen=True)
class Outcome:
    """Hold the output of the command, and the answers of the map."""

    status: str
    message: str
    answers: str = ""


class EndOfChecksError(Exception):
    """The recording passed the checks."""


def end_checks(*_: object) -> None:
    """Take the place of SLAM or mapping."""
    raise EndOfChecksError


def run_variant(variant: Variant, data: Path, work: Path, is_check: bool = False) -> Outcome:
    """Map a variant as a user does."""
    names = variant.base.split(" and ")[:1]
    pairs = [(names[0], variant.change), *([variant.second] if variant.second else [])]
    walks = [change(read_walk(name, data, work)) for name, change in pairs]
    folder = Path(tempfile.mkdtemp(dir=work))
    paths = [walk.write(folder / f"walk{k}") for k, walk in enumerate(walks)]
    target = folder / "map.topo"
    arguments = [*map(str, paths), str(target), "--features", "surf"]
    out, error, status = io.StringIO(), io.StringIO(), 0
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(error))
        for place in (slam, build) if is_check else ():
            name = "_track_recording" if place is slam else "build_node_map"
            stack.enter_context(mock.patch.object(place, name, end_checks))
        try:
            status = run_topoloc(["build", *arguments])
        except EndOfChecksError:
            pass
        except Exception:  # a finding of its own
            return Outcome("traceback", traceback.format_exc().strip().splitlines()[-1])
    lines = [line for line in error.getvalue().splitlines() if _is_message(line)]
    message = (lines or [""])[-1].replace(str(folder), "")
    if status:
        return Outcome("refused", message)
    if is_check:
        return Outcome("warned" if lines else "silent", message)
    answers = ask(target, read_walk(names[0], data, work), walks[0])
    return Outcome("warned" if lines else "silent", message, answers)


def _is_message(line: str) -> bool:
    return bool(line.strip()) and "\r" not in line and "█" not in line


def ask(target: Path, right: Walk, mapped: Walk) -> str:
    """Localize images of the right recording. If the poses were computed, the first image is the
    origin."""
    poses = right.poses
    localizer, errors = Localizer(TopoMetricMap.load(target)), list[float]()
    rows = np.unique(np.linspace(0, len(right.lefts) - 1, 6).astype(int)).tolist()
    camera = right.camera if right.rig is None else right.rig.left
    for row in rows:
        result = localizer.localize(read_image(right.lefts[row]), camera)
        if isinstance(result, Localization):
            pose = result.world_from_cam
            if poses is not None:
                first = poses[0] if mapped.poses is None else None
                truth = first.inverse() @ poses[row] if first else poses[row]
                errors.append(float(np.linalg.norm(pose.translation - truth.translation)))
            else:
                errors.append(float("nan"))
    return f"{len(errors)} of {len(rows)}, {np.median(errors or [np.nan]):.3f} m"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shared = Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    parser.add_argument("--shared", type=Path, default=shared)
    parser.add_argument("--only", default="", help="variants whose names contain one of A;B;...")
    parser.add_argument("--right", action="store_true", help="right variants alone")
    parser.add_argument("--wrong", action="store_true", help="wrong variants alone")
    parser.add_argument("--checks", action="store_true", help="end before SLAM and mapping")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    data, found = arguments.shared.resolve() / "data", dict[str, dict[str, str]]()
    groups = {"wrong": wrong_variants(), "right": right_variants()}
    if arguments.right or arguments.wrong:
        groups = {name: groups[name] for name in groups if getattr(arguments, name)}
    with tempfile.TemporaryDirectory() as work:
        for group, variants in groups.items():
            rows = [
                one for one in variants if any(p in one.name for p in arguments.only.split(";"))
            ]
            for variant in rows:
                outcome = run_variant(variant, data, Path(work), arguments.checks)
                found[f"{group}, {variant.name}"] = vars(outcome)
                line = " | ".join((outcome.status, outcome.answers, outcome.message))
                print(f"| {group} | {variant.name} | {line} |", flush=True)
                if arguments.json:
                    arguments.json.write_text(json.dumps(found, indent=1))
            statuses = [found[f"{group}, {one.name}"]["status"] for one in rows]
            counts = {name: statuses.count(name) for name in sorted(set(statuses))}
            print(f"{group}: {len(rows)} variants, {counts}", flush=True)


if __name__ == "__main__":
    main()
