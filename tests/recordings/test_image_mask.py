"""Check masks of what moves with the camera: what they leave out, and a robot's body painted over
the lab, mapped and localized as without the body."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from room_frames import depth_frame, walk
from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.demo.recordings import SHIPPED
from topoloc.errors import CalibrationError, UnreadableImageError
from topoloc.features.extraction import drop_masked, extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.geometry.camera import UncalibratedCamera
from topoloc.recordings.frame import MemorySequence, StereoFrame, to_grey
from topoloc.recordings.image_mask import fill_masked, mask_recording, read_mask, with_mask
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular, read_left_frame

LAB_SIZE = (640, 400)
BELOW = np.arange(240)[:, None] < np.full(320, 170)
"""Uses the rows above 170."""


def write_mask(path: Path, used: np.ndarray) -> str:
    assert cv2.imwrite(str(path), np.where(used, 255, 0).astype(np.uint8))
    return str(path)


def used_of(width: int, height: int) -> np.ndarray:
    """Return a mask of a bonnet: an arc over the lower edge."""
    columns = np.arange(width) / width
    top = height * (0.66 + 0.4 * (columns - 0.5) ** 2)
    return np.arange(height)[:, None] < top[None, :]


def paint_body(path: Path, used: np.ndarray) -> None:
    small = np.random.default_rng(3).integers(0, 255, (67, 107, 3), dtype=np.uint8)
    body = cv2.resize(small, used.shape[::-1], interpolation=cv2.INTER_CUBIC)
    if path.parent.name == "image_3":  # as far from the camera as what it sees
        body = np.roll(body, -12, axis=1)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert image is not None
    assert cv2.imwrite(str(path), np.where(used[:, :, None], image, body))


@pytest.fixture(scope="module")
def with_body(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of a lap and a walk of the lab whose camera sees the robot's body, and of
    their mask at half their size."""
    root = tmp_path_factory.mktemp("body")
    for name in ("map_lap1", "day"):
        shutil.copytree(SHIPPED / name, root / name)
        for path in (root / name).rglob("*.jpg"):
            paint_body(path, used_of(*LAB_SIZE))
    write_mask(root / "mask.png", used_of(320, 200))
    return root


def answers(map_path: Path, walk_of: Path, *options: str) -> tuple[float, float]:
    """Return the share of right answers (5 cm, 5 degrees), and the median error, metres."""
    out = map_path.with_suffix(".json")
    assert main(["evaluate", str(map_path), str(walk_of), *options, "--json", str(out)]) == 0
    (found,) = json.loads(out.read_text())["recordings"]
    return found["recall"]["0.05m_5deg"], found["median_translation_m"]


def test_with_its_mask_a_body_costs_nothing(
    with_body: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["build", f"{SHIPPED / 'map_lap1'}@0::2", str(tmp_path / "plain.topo")]) == 0
    expected, _ = answers(tmp_path / "plain.topo", SHIPPED / "day")
    capsys.readouterr()
    lap, mask = f"{with_body / 'map_lap1'}@0::2", str(with_body / "mask.png")
    assert main(["build", lap, str(tmp_path / "body.topo")]) == 0
    told = capsys.readouterr().err
    assert "moves with the camera" in told
    assert "--mask FILE" in told
    assert main(["build", lap, str(tmp_path / "masked.topo"), "--mask", mask]) == 0
    assert "moves with the camera" not in capsys.readouterr().err
    right, median = answers(tmp_path / "masked.topo", with_body / "day", "--mask", mask)
    assert right >= 0.95 * expected
    assert expected > 0.95
    assert median < 0.01
    spoilt, _ = answers(tmp_path / "body.topo", with_body / "day")
    assert spoilt < 0.5 * expected
    query, out = f"{with_body / 'day'}@3:6", tmp_path / "answers.jsonl"
    words = [str(tmp_path / "masked.topo"), query, "--mask", mask]
    capsys.readouterr()
    assert main(["follow", *words]) == 0
    assert main(["localize", *words, "--single", "--json", str(out)]) == 0
    lines = [*capsys.readouterr().out.splitlines()[:3], *out.read_text().splitlines()]
    assert [json.loads(line)["localized"] for line in lines] == 6 * [True]


def test_slam_and_update_take_a_mask(
    with_body: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    mask, lap = str(with_body / "mask.png"), f"{with_body / 'map_lap1'}@0:24"
    facts = tmp_path / "facts.json"
    words = ["slam", lap, str(tmp_path / "lap.tum"), "--mask", mask, "--json", str(facts)]
    assert main(words) == 0
    assert json.loads(facts.read_text())["ate_m"] < 0.02
    target = str(tmp_path / "lap.topo")
    assert main(["build", lap, target, "--mask", mask]) == 0
    assert main(["update", target, f"{with_body / 'map_lap1'}@24:40", "--mask", mask]) == 0
    assert "moves with the camera" not in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["surf", "sift"])
def test_no_features_are_of_the_body(with_body: Path, kind: str):
    mask = read_mask(with_body / "mask.png")
    frame = mask_recording(open_sequence(with_body / "day"), mask)[3]
    assert frame.camera is not None
    config = replace(FeatureConfig(), kind=kind)
    as_it_is = extract_features(to_grey(open_sequence(with_body / "day")[3].image), config)
    assert not frame.camera.is_in_image(as_it_is.points_img).all()
    found = extract_features(to_grey(frame.image), config)
    kept = drop_masked(found, frame.camera)
    assert len(kept.points_img) > 0.95 * len(found.points_img)
    assert frame.camera.is_in_image(kept.points_img).all()
    columns, rows = np.rint(kept.points_img).astype(int).T
    assert used_of(*LAB_SIZE)[np.maximum(rows - 2, 0), columns].all()


def test_a_filled_image_continues_its_surroundings():
    image = np.full((240, 320, 3), [200, 100, 50], np.uint8)
    image[170:] = np.random.default_rng(0).integers(0, 255, (70, 320, 3))
    filled = fill_masked(image, BELOW)
    assert np.array_equal(filled[:170], image[:170])
    assert np.abs(filled[170:].astype(int) - [200, 100, 50]).max() <= 3
    assert np.array_equal(fill_masked(filled, BELOW), filled)
    assert fill_masked(image, np.ones_like(BELOW)) is image


def test_a_mask_scales_with_the_camera():
    masked = with_mask(CAMERA, BELOW)
    assert masked == CAMERA
    at = np.array([[10.0, 160.0], [10.0, 180.0], [np.nan, 3.0], [-0.5, -0.5], [319.4, 169.4]])
    expected = [True, False, False, True, True]
    assert masked.is_in_image(at).tolist() == expected
    half = masked.rescaled(160, 120)
    assert half.is_in_image((at + 0.5) / 2 - 0.5).tolist() == expected
    assert masked.with_focal(200.0).is_in_image(at).tolist() == expected
    unknown = with_mask(UncalibratedCamera.unknown(320, 240), BELOW)
    assert unknown.rescaled(160, 120).with_focal(100.0).mask is BELOW


def test_frames_of_a_masked_recording_have_no_pixels_of_the_body():
    frames = walk([0.0, 0.2]).frames
    sequence = mask_recording(MemorySequence(frames), BELOW)
    assert len(sequence) == 2
    frame = sequence[1:][0]
    assert frame.rig is not None
    assert frame.rig.left.mask is BELOW
    assert frame.world_from_cam == frames[1].world_from_cam
    assert not np.array_equal(frame.image[170:], frames[1].image[170:])
    left = read_left_frame(sequence, 1)
    assert np.array_equal(left.image, frame.image)
    assert as_monocular(sequence)[1].camera.mask is BELOW  # pyright: ignore[reportOptionalMemberAccess]
    depth = mask_recording(MemorySequence([depth_frame(0.0)]), BELOW)[0].depth
    assert depth is not None
    assert np.isnan(depth.depth[170:]).all()
    assert np.isfinite(depth.depth[:160]).any()
    photo = StereoFrame("photo.jpg", 0, frames[0].image, None)
    assert not np.array_equal(mask_recording(MemorySequence([photo]), BELOW)[0].image, photo.image)


def test_wrong_masks_are_told_in_one_line(
    with_body: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    lap, out = f"{SHIPPED / 'map_lap1'}@0:4", str(tmp_path / "map.topo")
    (tmp_path / "notes.txt").write_text("no picture")
    write_mask(tmp_path / "black.png", np.zeros((400, 640), bool))
    write_mask(tmp_path / "other.png", used_of(640, 480))
    faults = {
        "black.png": "leaves out the whole picture",
        "other.png": "the mask has 640x480 pixels, the picture 640x400",
        "notes.txt": "notes.txt",
        "missing.png": "missing.png",
        ".": str(tmp_path),
    }
    for name, fault in faults.items():
        for words in (["build", lap, out], ["slam", lap, str(tmp_path / "a.tum")]):
            assert main([*words, "--mask", str(tmp_path / name)]) == 1, name
            (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
            assert fault in line, name
    assert cv2.imwrite(str(tmp_path / "ones.png"), np.ones((240, 320), np.uint8))
    with pytest.raises(CalibrationError, match=r"brightest value is 1"):
        read_mask(tmp_path / "ones.png")
    with pytest.raises(UnreadableImageError):
        read_mask(tmp_path / "notes.txt")
    with pytest.raises(CalibrationError, match="one image for all pictures"):
        read_mask(tmp_path)
