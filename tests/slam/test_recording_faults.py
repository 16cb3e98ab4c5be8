"""Check that faults of a recording which no single image shows are told: stuck, radial and late
depth, a camera that lost a picture, the robot's own body. Right recordings are not accused."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from room_frames import FrameList, depth_frame, walk
from topoloc.demo.recordings import SHIPPED
from topoloc.errors import RecordingError
from topoloc.localization.map_facts.map_building import build_map
from topoloc.recordings.depth_range import find_stuck_depth, leave_out_stuck_depth
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.slam.calibration_checks import find_image_faults
from topoloc.slam.depth_checks import find_late_depth
from topoloc.slam.input_checks import check_stereo
from topoloc.slam.still_part import find_still_part

PLACES = [0.2 * k for k in range(16)]
KITCHEN = Path("data/seven_scenes/kitchen/seq-01@0:160:5")


def frames_of(sequence: StereoSequence) -> list[StereoFrame]:
    return [sequence[k] for k in range(len(sequence))]


def with_depth(frame: StereoFrame, change: Callable[[np.ndarray], np.ndarray]) -> StereoFrame:
    assert frame.depth is not None
    changed = change(frame.depth.depth).astype(np.float32)
    return replace(frame, depth=replace(frame.depth, depth=changed))


@pytest.fixture
def kitchen(shared: Path) -> list[StereoFrame]:
    return frames_of(open_sequence(shared / KITCHEN))


@pytest.mark.parametrize("reach", [2.8, 3.5])
def test_depth_that_sticks_at_the_range_is_left_out(reach: float):
    frames = [depth_frame(place) for place in PLACES]
    stuck = [with_depth(one, lambda depth: np.minimum(depth, reach)) for one in frames]
    notes = list[str]()
    known = leave_out_stuck_depth(FrameList(stuck), notes.append)
    assert len(notes) == 1
    assert f"depth of {reach:g} m is left out" in notes[0]
    depth = known[3].depth
    assert depth is not None
    assert np.nanmax(depth.depth) < reach
    assert np.isnan(depth.depth).mean() == pytest.approx(np.mean(stuck[3].depth.depth >= reach))  # pyright: ignore[reportOptionalMemberAccess]
    assert known[3:5][0].depth is not None
    assert np.nanmax(known[3:5][0].depth.depth) < reach
    assert leave_out_stuck_depth(known) is known


def test_integers_that_end_at_sixteen_bits_are_left_out(kitchen: list[StereoFrame]):
    end = 3.2767
    stuck = [
        with_depth(one, lambda depth: np.fmin(np.nan_to_num(depth, nan=9.0), end))
        for one in kitchen
    ]
    found = find_stuck_depth(FrameList(stuck))
    assert found == pytest.approx(end)


def test_a_wall_and_real_depth_are_not_stuck(kitchen: list[StereoFrame]):
    assert find_stuck_depth(FrameList(kitchen)) is None
    assert find_stuck_depth(FrameList([depth_frame(place) for place in PLACES])) is None
    wall = [with_depth(one, lambda depth: np.full_like(depth, 2.0)) for one in kitchen]
    assert find_stuck_depth(FrameList(wall)) is None
    assert find_stuck_depth(walk(PLACES[:4])) is None


@pytest.mark.parametrize("unit", [1.0, 1.03])
def test_depth_along_the_ray_is_told(kitchen: list[StereoFrame], unit: float):
    def along_ray(frame: StereoFrame) -> StereoFrame:
        assert frame.depth is not None
        v, u = np.indices(frame.depth.depth.shape)
        c = frame.depth.camera
        rays = np.sqrt(1.0 + ((u - c.cx) / c.fx) ** 2 + ((v - c.cy) / c.fy) ** 2)
        return with_depth(frame, lambda depth: unit * rays * depth)

    assert find_image_faults(FrameList(kitchen)) == []
    notes = find_image_faults(FrameList([along_ray(one) for one in kitchen]))
    assert [note for note in notes if "depth is the distance from the camera, not z" in note]


@pytest.mark.parametrize(("lag", "word"), [(1, "late"), (-1, "early")])
def test_depth_of_another_frame_is_told(kitchen: list[StereoFrame], lag: int, word: str):
    assert find_late_depth(FrameList(kitchen)) is None
    shifted = [
        replace(one, depth=other.depth)
        for one, other in zip(kitchen[2:-2], kitchen[2 - lag : len(kitchen) - 2 - lag], strict=True)
    ]
    note = find_late_depth(FrameList(shifted))
    assert note is not None
    assert f"depth is a frame {word}" in note


@pytest.mark.parametrize("first", [12, 30])
def test_a_lost_picture_is_named_with_its_frame_and_the_remedy_works(first: int):
    lab = frames_of(open_sequence(SHIPPED / "map_lap1@0:46"))
    wrong = [
        replace(one, right=lab[min(k + (k >= first), len(lab) - 1)].right)
        for k, one in enumerate(lab)
    ]
    with pytest.raises(RecordingError, match="no pairs of one moment") as caught:
        check_stereo(FrameList(wrong, "lab"))
    assert f"of frames {first} to" in str(caught.value)
    (rest,) = re.findall(r"lab@0:(\d+)", str(caught.value))
    check_stereo(FrameList(wrong[: int(rest)], "lab"))


def test_a_stretch_of_wrong_pairs_is_named_from_its_first_to_its_last():
    lab = frames_of(open_sequence(SHIPPED / "map_lap1@0:46"))
    wrong = [
        replace(one, right=lab[k + 1].right) if 15 <= k < 27 else one for k, one in enumerate(lab)
    ]
    with pytest.raises(RecordingError, match=r"frames 15 to 26 .*lab@0:15,27:46"):
        check_stereo(FrameList(wrong, "lab"))


def with_body(
    frames: list[StereoFrame], rows: slice, columns: slice, side: int
) -> list[StereoFrame]:
    """Return frames with squares that move with the camera, and noise."""
    rng = np.random.default_rng(1)
    squares = np.kron(rng.integers(0, 255, (30, 40)), np.ones((side, side)))
    changed = list[StereoFrame]()
    for frame in frames:
        image = frame.image.astype(np.float64)
        image[rows, columns] = squares[: image.shape[0], : image.shape[1]][rows, columns]
        image += rng.normal(0.0, 2.0, image.shape)
        changed.append(replace(frame, image=np.clip(image, 0, 255).astype(np.uint8)))
    return changed


LOWER_THIRD = slice(160, 240), slice(None)


@pytest.mark.parametrize(
    ("rows", "columns", "side"), [(*LOWER_THIRD, 9), (slice(None), slice(0, 60), 13)]
)
def test_a_body_that_moves_with_the_camera_is_told(rows: slice, columns: slice, side: int):
    frames = walk(PLACES).frames
    assert find_still_part(FrameList(frames)) is None
    note = find_still_part(FrameList(with_body(frames, rows, columns, side)))
    assert note is not None
    assert "moves with the camera" in note


def test_a_camera_that_stands_has_no_body():
    frames = 12 * walk(PLACES[:1]).frames
    assert find_still_part(FrameList(with_body(frames, *LOWER_THIRD, 9))) is None


def test_mapping_with_poses_tells_of_a_body():
    frames, notes = with_body(walk(PLACES).frames, *LOWER_THIRD, 9), list[str]()
    build_map(FrameList(frames), are_poses_checked=False, warn=notes.append)
    assert any("moves with the camera" in note for note in notes)
