"""Test `topoloc certify`: it computes, stores and draws the certificate of a map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from built_room import unseen_views, write_pictures
from topoloc.apps.cli import main
from topoloc.mapping.certificate import Certificate
from topoloc.mapping.edit import edit_map

Complaint = Callable[..., str]


@pytest.fixture
def own_map(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    views, random = unseen_views()[:4], np.random.default_rng(0)
    noise = [random.integers(0, 255, view[0].shape, np.uint8) for view in views]
    mixed = [(image, *view[1:]) for image, view in zip(noise, views, strict=True)]
    folder = write_pictures(tmp_path / "elsewhere", mixed)
    (folder / "truth.tum").unlink()
    return folder


def test_certify_prints_stores_and_draws_the_promise(
    own_map: Path,
    queries: Path,
    elsewhere: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    command = ["certify", str(own_map), "--walk", str(queries), "--out-of-map", str(elsewhere)]
    outputs = ["--json", str(tmp_path / "c.json"), "--report", str(tmp_path / "c.html")]
    command += ["--by", "light,angle"]
    assert main([*command, *outputs]) == 0
    printed = capsys.readouterr().out
    found = json.loads((tmp_path / "c.json").read_text())
    assert found["promise"] in printed
    by_name = {one["name"]: one for one in found["conditions"]}
    assert by_name["unseen"]["num_wrong"] == 0
    assert by_name["unseen"]["num_localized"] >= len(unseen_views()) - 1
    assert (by_name["elsewhere"]["num_images"], by_name["elsewhere"]["num_localized"]) == (4, 0)
    assert len(found["answers"]) == sum(one["num_images"] for one in found["conditions"])
    page = (tmp_path / "c.html").read_text()
    assert "elsewhere" in page
    assert "<svg" in page
    by_light = [one for one in found["groups"] if one["by"] == "light"]
    assert [one["num_images"] for one in by_light] == [len(unseen_views()), 0, 0]
    assert {one["by"] for one in found["quarters"]} == {"inliers", "angle", "light"}
    assert main(["info", str(own_map)]) == 0
    shown = capsys.readouterr().out
    for text in (printed, shown, page):
        assert found["promise"][1:] in text
        assert "not applied (topoloc certify --apply); with it at most" in text
        assert "light 1 to 1.25" in text
        assert "angle 30 deg or more" in text
        assert "hardest to easiest" in text
    scene = tmp_path / "scene.json"
    assert main(["view", str(own_map), "--json", str(scene)]) == 0
    certificate = json.loads(scene.read_text())["map"]["certificate"]
    assert certificate["threshold"] in shown
    assert len(certificate["group_promises"]) == len(found["groups"])
    name, _, promise = certificate["group_promises"][0].partition(": ")
    assert name.startswith(found["groups"][0]["by"])
    assert name in shown
    assert promise in shown
    assert main(["georeference", str(own_map), "--origin", "50.8,4.7,30,0"]) == 0
    capsys.readouterr()
    assert main(["info", str(own_map)]) == 0
    assert "outdated: of version 2" in capsys.readouterr().out


def test_a_certificate_of_an_older_version_is_shown_as_it_was_measured(
    own_map: Path, queries: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["certify", str(own_map), "--walk", str(queries)]) == 0
    with edit_map(own_map) as edit:
        assert edit.topomap.certificate is not None
        facts = edit.topomap.certificate.to_json() | {"min_probability": 0.8}
        for name in ("threshold_wrong_share", "quarters", "groups"):  # came later
            del facts[name]
        older = msgspec.convert(facts, Certificate)
        edit.commit(replace(edit.topomap, certificate=older), "certify")
    capsys.readouterr()
    assert main(["info", str(own_map)]) == 0
    shown = capsys.readouterr().out
    assert "get a wrong pose at a probability of at least 0.8, with 95 % confidence" in shown
    assert "0.8, not applied (topoloc certify --apply); it would refuse" in shown


def test_a_map_alone_states_the_limits_of_that(own_map: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["certify", str(own_map)]) == 0
    printed = capsys.readouterr().out
    assert "no walk with known poses: other light and changed things are not tested" in printed
    assert "no images of elsewhere (--out-of-map)" in printed


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["--max-wrong", "0"], "--max-wrong must be a percentage"),
        (["--walk", "missing"], "missing: no such file or folder"),
        (["--map-from-truth", "missing.json"], "missing.json"),
        (["--by", "light"], "--by groups the images of walks with true poses: add --walk SEQ"),
        (["--by", "light,day"], "--by takes light, angle or light,angle, not 'day'"),
    ],
)
def test_wrong_arguments_are_one_line(
    own_map: Path, complaint: Complaint, arguments: list[str], fault: str
):
    before, status = own_map.read_bytes(), 2 if arguments[0] in ("--max-wrong", "--by") else 1
    assert fault in complaint("certify", str(own_map), *arguments, status=status)
    assert own_map.read_bytes() == before
