"""topoloc explain MAP IMAGE."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc.cli.features_option import ASKED_FEATURES, localizer_of
from topoloc.cli.output import File, UsageError, check_outputs, write_json
from topoloc.cli.query_camera import camera_of_frame, named_camera
from topoloc.cli.settings_file import read_settings, with_option
from topoloc.evaluation.explanation import Explanation, explain
from topoloc.evaluation.explanation_page import row_of, verdict, write_explanation
from topoloc.localization.localizer import LocalizerConfig
from topoloc.map.topomap import TopoMetricMap
from topoloc.sequences.open import open_sequence
from topoloc.sequences.recording import single_pictures


@dataclass(frozen=True)
class Command:
    """What `topoloc explain` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file."""
    image: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="IMAGE")]
    """The picture; or one of a recording, as in walk@17."""
    camera: Annotated[
        str | None, tyro.conf.arg(metavar="FILE|fx,fy,cx,cy|map|unknown", help_behavior_hint="(default: that of the recording)")
    ] = None
    """Its calibration, as `topoloc localize` takes it."""
    coarse: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the map's)")] = None
    """Coarse localizer that is asked; `topoloc info` names those of the map."""
    features: ASKED_FEATURES = None
    """Which of the map's features are asked; of several, the next where the one before leaves the pose unclear."""
    out: File = None
    """Write a page with the pictures, the matches and all that was tried to this file (HTML)."""
    json: File = None
    """Write what is printed as JSON to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config explain` prints it."""

    def run(self) -> int:
        check_outputs([self.out, self.json], inputs=[path for path in (self.map, self.config) if path])
        config = with_option(read_settings(self.config).of(LocalizerConfig), "coarse", self.coarse, "--coarse")
        with TopoMetricMap.load(self.map) as topomap:
            of_size = None if self.camera is None else named_camera(self.camera, topomap)
            localizer = localizer_of(topomap, config, self.features)
            sequence = single_pictures(open_sequence(self.image))
            if len(sequence) != 1:
                raise UsageError(f"explain takes one picture, and {self.image} has {len(sequence)}; {self.image}@0 is its first")
            frame = sequence[0]
            explanation = explain(localizer, frame.image, camera_of_frame(frame, of_size))
            if self.out:
                write_explanation(Path(self.out), frame.name, frame.image, explanation, topomap)
        if self.json != "-":
            _print(explanation, self.out)
        write_json(self.json, _facts(frame.name, explanation))
        return 0


def _print(explanation: Explanation, page: str | None) -> None:
    print(verdict(explanation))
    for line in explanation.advice:
        print(f"- {line}")
    for pose in explanation.poses:
        source, features, node, first, found, _, _, probability, became = row_of(pose)
        facts = ", ".join(text for text in (node and f"node {node}", f"{first} at first", found and f"found {found}", probability) if text)
        print(f"  {source} ({features}): {facts}: {became}")
    if page:
        print(f"page: {page}")


def _facts(name: str, explanation: Explanation) -> dict[str, Any]:
    poses = [
        {
            "source": pose.tried.source,
            "features": pose.tried.features,
            "node": pose.fit.node_id if pose.fit.node_id >= 0 else None,
            "num_first_matches": len(pose.tried.first.matches),
            "num_first_inliers": pose.tried.first.num_inliers,
            "probability": pose.probability,
            "verdict": pose.verdict,
        }
        for pose in explanation.poses
    ]
    return explanation.result.to_json(name) | {"advice": explanation.advice, "num_features": explanation.num_features, "tried": poses}
