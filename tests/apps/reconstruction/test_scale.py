"""Test the metric scale of a reconstruction: each source alone, their mean, and contradictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import photographed_room as room
import room_frames
import tiny_world
from topoloc.apps.reconstruction import scale as scale_module
from topoloc.apps.reconstruction.photos import PosedView, Reconstruction, SeenPoints
from topoloc.apps.reconstruction.scale import ScaleSource, combine_sources, find_scale
from topoloc.errors import RecordingError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import MemorySequence, StereoFrame, StereoSequence

UNIT = 0.4  # metres: what is to be found
NO_POINTS = SeenPoints(np.zeros((0, 2)), np.zeros(0))


def _in_units(
    sequence: StereoSequence, poses: list[Rigid3], seen: list[SeenPoints]
) -> Reconstruction:
    scaled: list[Rigid3 | None] = [Rigid3(pose.rotation, pose.translation / UNIT) for pose in poses]
    rows, cameras = list(range(len(poses))), [tiny_world.CAMERA] * len(poses)
    return Reconstruction([PosedView(sequence, rows, scaled, cameras=cameras)], seen)


@pytest.fixture(scope="module")
def photos() -> Reconstruction:
    numbers = range(0, 18, 4)
    frames = [
        StereoFrame(room.NAMES[k], k * 10**9, room.photo(k), tiny_world.CAMERA) for k in numbers
    ]
    poses = [room.photo_pose(k) for k in numbers]
    return _in_units(MemorySequence(frames, "photos"), poses, [NO_POINTS] * len(poses))


def test_a_tag(photos: Reconstruction):
    told = list[str]()
    scale = find_scale(photos, [], room.TAG_SIDE, told.append)
    assert scale.metres == pytest.approx(UNIT, rel=0.01)
    assert 0.003 <= scale.sigma < 0.01
    assert "tag 7 of APRILTAG_36h11 in 5 images" in told[0]


def test_a_distance(photos: Reconstruction):
    text = f"{room.NAMES[0]},{room.NAMES[8]}={room.distance(0, 8):.3f}m"
    scale = find_scale(photos, [text], None, None)
    assert scale.metres == pytest.approx(UNIT, rel=0.002)
    of_tape = 0.01 / room.distance(0, 8)
    assert scale.sigma == pytest.approx(np.linalg.norm([of_tape, 0.01, 0.003]), rel=0.01)
    with pytest.raises(TrajectoryError, match="0 images are named IMG_9999"):
        find_scale(photos, [f"IMG_9999.jpg,{room.NAMES[8]}=1m"], None, None)


def test_a_tag_of_a_wrong_size_contradicts_a_distance(photos: Reconstruction):
    text = f"{room.NAMES[0]},{room.NAMES[8]}={room.distance(0, 8):.3f}"
    with pytest.raises(RecordingError, match=r"contradict each other.*IMG_0008.*tag 7"):
        find_scale(photos, [text], 1.1 * room.TAG_SIDE, None)


def test_no_source_and_no_tag_in_view(photos: Reconstruction):
    with pytest.raises(RecordingError, match="--scale IMAGE_A,IMAGE_B=METRES"):
        find_scale(photos, [], None, None)
    two = photos.sequences[0]
    poses: list[Rigid3 | None] = [*two.poses[:2], *[None] * (len(two) - 2)]
    few = Reconstruction([replace(two, poses=poses)], photos.seen)
    with pytest.raises(RecordingError, match="tag 7 of APRILTAG_36h11 in 2 images"):
        find_scale(few, [], room.TAG_SIDE, None)


def test_gnss_that_contradicts_a_tag_is_left_out_and_said(
    photos: Reconstruction, monkeypatch: pytest.MonkeyPatch
):
    warned = list[str]()
    monkeypatch.setattr(scale_module, "read_exif_places", lambda found: (np.zeros((9, 3)), [0] * 9))
    monkeypatch.setattr(scale_module, "fit_places", lambda *places: (2.0 * UNIT, 0.1))
    scale = find_scale(photos, [], room.TAG_SIDE, None, warned.append)
    assert scale.metres == pytest.approx(UNIT, rel=0.01)
    assert "GNSS in EXIF of 9 images" in warned[0]
    assert "contradict each other" in warned[0]
    alone = find_scale(photos, [], None, None)
    assert alone.metres == pytest.approx(2.0 * UNIT)
    assert alone.sigma == pytest.approx(0.1, rel=0.01)


def test_depth_images():
    places = [0.0, 3.0, 6.0, 9.0]
    frames = [replace(room_frames.depth_frame(one), t_ns=k * 10**9) for k, one in enumerate(places)]
    columns, lines = (one.ravel() for one in np.meshgrid(range(20, 300, 20), range(20, 220, 20)))
    seen = list[SeenPoints]()
    for frame in frames:
        assert frame.depth is not None
        depths = frame.depth.depth[lines, columns].astype(np.float64)
        known = np.isfinite(depths)
        pixels = np.column_stack([columns, lines])[known].astype(np.float64)
        seen.append(SeenPoints(pixels, depths[known] / UNIT))
    poses = [tiny_world.path_pose(one) for one in places]
    scale = find_scale(_in_units(MemorySequence(frames), poses, seen), [], None, None)
    assert scale.metres == pytest.approx(UNIT, rel=0.003)
    assert scale.sigma >= 0.01


def test_sources_are_weighed_by_their_sigmas():
    exact, vague = ScaleSource("tag", 0.40, 0.004), ScaleSource("distance", 0.41, 0.04)
    both = combine_sources("photos", [exact, vague], 0.003)
    assert 0.40 < both.metres < 0.4005
    assert both.sigma < np.hypot(0.004, 0.003)
    scattered = [ScaleSource("a", 0.40, 0.01), ScaleSource("b", 0.415, 0.01)]
    assert combine_sources("photos", scattered, 0.0).sigma > 0.01
    with pytest.raises(RecordingError, match=r"tag: 0.4 m, distance: 0.6 m"):
        combine_sources("photos", [exact, replace(vague, metres=0.6)], 0.003)
