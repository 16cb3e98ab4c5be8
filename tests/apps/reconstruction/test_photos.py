"""Test maps of photos without poses, in any order, of a camera without calibration: the command
line, from images to a map in metres."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from photographed_room import NAMES, TAG_SIDE, distance, photo, photo_pose, write_photos
from topoloc.apps.cli import main
from topoloc.geometry.alignment import align_similarity
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap

needs_colmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="the extra colmap is not installed"
)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photos(tmp_path_factory.mktemp("photos") / "room")


def _build(photos: Path, target: Path, *options: str) -> int:
    return main(["build", str(photos), str(target), "--features", "surf", *options])


@needs_colmap
def test_photos_of_a_tag_become_a_metric_map(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    target = tmp_path / "room.topo"
    assert _build(photos, target) == 1  # no scale: refused with the remedies
    refused = capsys.readouterr().err
    remedies = ("no scale", "--scale IMAGE_A,IMAGE_B=", "--tag METRES", "--scale none")
    assert all(one in refused for one in remedies)
    assert not target.exists()

    # what was computed is kept: no image is matched again
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("topoloc.apps.reconstruction.photos.match_views", None)
        assert _build(photos, target, "--tag", str(TAG_SIDE)) == 0
        told = capsys.readouterr().out
        wrong = ["--scale", f"{NAMES[0]},{NAMES[3]}={1.3 * distance(0, 3)}"]
        assert _build(photos, tmp_path / "other.topo", "--tag", str(TAG_SIDE), *wrong) == 1
    assert "scale known to" in told
    assert "tag 7 of APRILTAG_36h11" in told
    assert "images localized without their run's nodes" in told
    contradiction = capsys.readouterr().err
    assert "contradict each other" in contradiction
    assert NAMES[3] in contradiction

    topomap = TopoMetricMap.load(target)
    found = {one.name: one.world_from_cam for one in topomap.summaries}
    assert len(found) >= 0.9 * len(NAMES)
    rows = [NAMES.index(name) for name in found]
    truth = np.array([photo_pose(row).translation for row in rows])
    positions = np.array([pose.translation for pose in found.values()])
    scale, true_from_map = align_similarity(truth, positions)
    assert scale == pytest.approx(1.0, abs=0.01)
    errors = np.linalg.norm(true_from_map.apply(scale * positions) - truth, axis=1)
    assert np.median(errors) < 0.01

    sigma = topomap.config.scale_sigma
    assert sigma is not None
    assert 0.003 < sigma < 0.03
    camera = topomap.nodes[0].camera
    pose = Localizer(topomap).localize(photo(5), camera)
    assert isinstance(pose, Localization)
    assert pose.position_sigma_m > 0.9 * sigma * np.linalg.norm(pose.world_from_cam.translation)


def _refusal(capsys: pytest.CaptureFixture[str], photos: Path, *options: str) -> str:
    """Return the only line of an error."""
    assert _build(photos, photos.parent / "refused.topo", *options) != 0
    (line,) = capsys.readouterr().err.splitlines()
    return line


@needs_colmap
def test_few_photos(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    line = _refusal(capsys, write_photos(tmp_path / "few", range(3)), "--tag", "0.1")
    assert "3 images are too few" in line
    assert "at least 6" in line


@needs_colmap
def test_photos_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "walls").mkdir()
    for number in range(8):
        cv2.imwrite(str(tmp_path / "walls" / f"{number}.png"), np.full((240, 320), 90, np.uint8))
    assert "no two of 8 images show the same place" in _refusal(capsys, tmp_path / "walls")


def test_without_the_extra(photos: Path, capsys: pytest.CaptureFixture[str], monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "pip install 'topoloc[colmap]'" in _refusal(capsys, photos)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--scale", "0.5"), "photos take a distance, --tag, or --scale none"),
        (("--tag", "-1"), "side of a tag in metres"),
        (("--poses", "opengl"), "those of photos are computed"),
        (("--trajectory", "slam", "--tag", "0.1"), "--trajectory photos"),
    ],
)
def test_options_that_do_not_fit(
    photos: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str
):
    assert said in _refusal(capsys, photos, *options)


@pytest.fixture(scope="module")
def without_scale(photos: Path) -> Path:
    target = photos.parent / "units.topo"
    assert _build(photos, target, "--scale", "none") == 0
    return target


@needs_colmap
def test_a_map_without_scale(
    photos: Path, without_scale: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    answers = tmp_path / "answers.jsonl"
    query = str(photos / NAMES[5])
    assert main(["localize", str(without_scale), query, "--json", str(answers)]) == 0
    assert " units, quat" in capsys.readouterr().out
    (line,) = answers.read_text().splitlines()
    answer = json.loads(line)
    assert answer["localized"]
    assert answer["scale"] == "none"
    assert not [key for key in answer if key.endswith("_m")]
    read = Localization.from_json(line)
    assert not read.provenance.has_scale
    assert " units" in repr(read)
    assert read.to_json().keys() == answer.keys()

    assert main(["info", str(without_scale), "--json", str(tmp_path / "facts.json")]) == 0
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["scale"] == "none"
    assert not [key for key in facts if key.endswith("_m")]
    assert "topoloc scale sets it" in capsys.readouterr().out


@needs_colmap
@pytest.mark.parametrize(
    "command",
    [
        ["follow", "MAP", "PHOTOS", "--ros"],
        ["follow", "MAP", "PHOTOS", "--mavlink", "udpout:127.0.0.1:9"],
        ["merge", "MAP", "MAP2", "merged.topo"],
        ["georeference", "MAP", "--origin", "50,8,100,0"],
        ["certify", "MAP", "--walk", "PHOTOS"],
        ["evaluate", "MAP", "PHOTOS"],
        ["level", "MAP"],
        ["route", "MAP", "0", "1"],
        ["export", "MAP", "out.mcap", "--format", "mcap"],
        ["update", "MAP", "PHOTOS"],
        ["localize", "MAP", "PHOTOS", "--tolerance", "0.1,2"],
    ],
)
def test_what_needs_metres_names_the_remedy(
    photos: Path,
    without_scale: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
):
    (tmp_path / "second.topo").write_bytes(without_scale.read_bytes())
    paths = {"MAP": without_scale, "MAP2": tmp_path / "second.topo", "PHOTOS": photos}
    assert main([str(paths.get(one, one)) for one in command]) != 0
    (line,) = capsys.readouterr().err.splitlines()
    assert f"topoloc scale {without_scale}" in line
