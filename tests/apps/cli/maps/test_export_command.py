"""Test `topoloc export`: formats by file name, complete outputs or none, links, and
refused exports."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc.apps.cli import main
from topoloc.localization.result import NotLocalized

Complaint = Callable[..., str]


@pytest.fixture
def refusals(tmp_path: Path) -> Path:
    path = tmp_path / "refused.jsonl"
    path.write_text(json.dumps(NotLocalized("not_in_map").to_json("a.png")) + "\n")
    return path


def test_an_output_without_a_known_suffix_needs_a_format(
    room_map: Path, tmp_path: Path, complaint: Complaint
):
    assert "--format takes colmap, nerfstudio" in complaint(
        "export", room_map, tmp_path / "room.zip"
    )
    assert "unknown format" in complaint(
        "export", room_map, tmp_path / "room.tum", "--format", "fbx"
    )


def test_a_map_without_a_place_on_earth_makes_no_geojson(
    room_map: Path, tmp_path: Path, complaint: Complaint
):
    assert "topoloc georeference" in complaint("export", room_map, tmp_path / "room.geojson")


def test_invalid_inputs_are_refused(tmp_path: Path, refusals: Path, complaint: Complaint):
    assert "none of 1 results has a pose" in complaint("export", refusals, tmp_path / "a.tum")
    broken = tmp_path / "broken.jsonl"
    broken.write_text('{"query": "a"}\n')
    assert "line 1: no result" in complaint("export", broken, tmp_path / "a.tum")
    broken.write_bytes(b"\x00\xff")
    assert "not a text file" in complaint("export", broken, tmp_path / "a.tum")
    os.mkfifo(tmp_path / "pipe")
    assert "is no map" in complaint("export", tmp_path / "pipe", tmp_path / "a.tum")
    assert "is no map but a folder" in complaint("export", tmp_path, tmp_path / "a.tum")
    for name in ("gone.topo", "gone.jsonl"):
        assert "cannot open map" in complaint("export", tmp_path / name, tmp_path / "a.tum")


def test_wrong_outputs(room_map: Path, tmp_path: Path, complaint: Complaint):
    assert "does not exist" in complaint("export", room_map, tmp_path / "none" / "model")
    assert "no session 7" in complaint("export", room_map, tmp_path / "a.tum", "--session", "7")
    full = tmp_path / "full"
    full.mkdir()
    (full / "thesis.tex").write_text("years of work")
    assert "holds other things, such as thesis.tex" in complaint("export", room_map, full)
    assert "it is no folder" in complaint(
        "export", room_map, full / "thesis.tex", "--format", "colmap"
    )


def test_a_folder_is_replaced_whole_and_links_are_followed(room_map: Path, tmp_path: Path):
    folder, link = tmp_path / "model", tmp_path / "link"
    link.symlink_to(folder)
    assert main(["export", str(room_map), str(link)]) == 0
    assert link.is_symlink()
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    names = ("cameras", "images", "points3D", "rigs", "frames")
    assert set(first) == {f"{name}{suffix}" for name in names for suffix in (".txt", ".bin")}
    (folder / "images.txt").write_text("of before")
    assert main(["export", str(room_map), str(folder)]) == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == first
    file_link, file = tmp_path / "poses.tum", tmp_path / "real.tum"
    file_link.symlink_to(file)
    assert main(["export", str(room_map), str(file_link)]) == 0
    assert file_link.is_symlink()
    assert file.read_text().startswith("# t tx ty tz")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "link",
        "model",
        "poses.tum",
        "real.tum",
    ]
