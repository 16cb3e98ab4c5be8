"""Read the files that commit aea690a wrote, and compare the answers."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator

from .answers import compare_answers, pose_difference
from .edits import digest
from .figures import Figure
from .workplace import FIXTURES, ROOT, Workplace, read_lines

FAST = ROOT / "benchmarks" / "fast.toml"  # without the last step, which aea690a had not


def old_files(work: Workplace) -> Iterator[Figure]:
    """Compare the fast answers of old maps with those that aea690a gave."""
    old = work.folder / "old"
    shutil.copytree(FIXTURES, old)
    expected = json.loads((old / "expected.json").read_text(encoding="utf-8"))
    for name, answers in expected["answers"].items():
        words = (old / name, old / "queries", "--config", FAST)
        found = compare_answers(answers, work.answer("localize", *words))
        yield Figure(f"{name}: other answers of {found.compared}", found.different, "at most")
    for name in ("schema_1.topo", "schema_2.topo", "schema_3.topo"):
        text = work.topoloc("info", old / name, "--check", status=None)
        yield Figure(f"{name}: info --check is ok", int(text.split()[-1:] == ["ok"]), "at least")
    settings = old / "settings.toml"
    text = settings.read_text(encoding="utf-8")
    settings.write_text(text.replace("[localize]", FAST.read_text(encoding="utf-8"), 1))
    words = (old / "schema_3.topo", old / "queries", "--config", settings)
    answers = work.answer("localize", *words)
    found = compare_answers(expected["answers"]["schema_3.topo"], answers)
    yield Figure(f"settings.toml: other answers of {found.compared}", found.different, "at most")
    before = digest(old / "pruned.topo")
    work.topoloc("undo", old / "pruned.topo", status=1)
    same = digest(old / "pruned.topo") == before
    yield Figure("pruned.topo.undo: refused, the same file", int(same), "at least")
    yield from _results(work)


def _results(work: Workplace) -> Iterator[Figure]:
    """Export the old results as a trajectory, and compare its poses with them."""
    results = work.folder / "old" / "results.jsonl"
    poses = [line["world_from_cam"] for line in read_lines(results) if line["localized"]]
    work.topoloc("export", results, work.folder / "results.tum")
    text = (work.folder / "results.tum").read_text(encoding="utf-8")
    rows = [[float(word) for word in row.split()] for row in text.splitlines() if row[0] != "#"]
    exported = [{"translation": row[1:4], "quat_wxyz": [row[7], *row[4:7]]} for row in rows]
    pairs = zip(poses, exported, strict=False)
    # The file has six to nine digits.
    right = sum(max(pose_difference(pose, row)) < 1e-5 for pose, row in pairs)
    yield Figure(f"results.jsonl: poses exported of {len(poses)}", right, "at least")
    scene = work.folder / "scene.json"
    work.topoloc("view", work.folder / "old" / "schema_3.topo", results, "--json", scene)
    yield Figure("results.jsonl: view reads it", int(scene.stat().st_size > 1000), "at least")
