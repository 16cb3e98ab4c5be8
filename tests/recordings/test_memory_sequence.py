"""Test frames in memory as a recording, and errors for arrays of another type, shape or unit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import topoloc
from tiny_recordings import HEIGHT, WIDTH, assert_slices, picture, pose
from topoloc.errors import RecordingError
from topoloc.recordings.frame import StereoSequence, find_image_problem, sequence_subset

CAMERA = topoloc.Camera.pinhole(WIDTH, HEIGHT, 40.0, 41.0, 15.5, 11.5)
RIG = topoloc.StereoRig.rectified(CAMERA, 0.12)
DEPTH = topoloc.DepthImage(np.full((HEIGHT, WIDTH), 2.0, np.float32), CAMERA)


def stereo(index: int = 0) -> topoloc.StereoFrame:
    return topoloc.StereoFrame(
        f"{index}", index * 100_000_000, picture(index), CAMERA, right=picture(100 + index), rig=RIG
    )


def rgbd(index: int = 0) -> topoloc.StereoFrame:
    return topoloc.StereoFrame(
        f"{index}",
        index * 100_000_000,
        picture(index, 3),
        CAMERA,
        depth=DEPTH,
        world_from_cam=pose(index),
    )


def test_a_sequence_of_frames():
    sequence = topoloc.MemorySequence((rgbd(index) for index in range(3)), "mine")
    assert isinstance(sequence, StereoSequence)
    assert (sequence.name, sequence.names, sequence.t_ns, len(sequence)) == (
        "mine",
        ["0", "1", "2"],
        [0, 100_000_000, 200_000_000],
        3,
    )
    np.testing.assert_array_equal(sequence[2].image, picture(2, 3))
    np.testing.assert_array_equal(DEPTH.cam_from_depth.matrix(), np.eye(4))
    assert [found is not None for found in sequence.poses] == [True] * 3
    assert sequence_subset(sequence, [2]).names == ["2"]
    assert_slices(sequence)
    assert topoloc.MemorySequence([stereo()]).poses == [None]


def changed(frame: topoloc.StereoFrame, **fields: Any) -> topoloc.StereoFrame:
    """Change a frame without type checks, because the tests' own checks run in the constructor."""
    for name, value in fields.items():
        object.__setattr__(frame, name, value)
    return frame


def depth_of(array: Any) -> topoloc.DepthImage:
    depth = topoloc.DepthImage(DEPTH.depth, CAMERA)
    object.__setattr__(depth, "depth", array)
    return depth


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (
            lambda: changed(stereo(), image=picture(0) / 255.0),
            r"type float64; .*\(255 \* image\)\.round\(\)",
        ),
        (
            lambda: changed(stereo(), image=picture(0).astype(np.float32)),
            r"type float32; .*image\.round\(\)\.clip",
        ),
        (lambda: changed(stereo(), image=picture(0).astype(np.uint16) * 257), r"16 bits; .*>> 8"),
        (lambda: changed(stereo(), image=picture(0).astype(np.int64)), "type int64"),
        (lambda: changed(stereo(), image=picture(0).tolist()), "not list"),
        (
            lambda: changed(stereo(), image=picture(0, 3).transpose(2, 0, 1)),
            r"channels first \(3x24x32\)",
        ),
        (
            lambda: changed(stereo(), image=np.dstack([picture(0, 3), picture(0)])),
            r"four channels .*\[:, :, :3\]",
        ),
        (lambda: changed(stereo(), image=picture(0)[:, :, None]), r"axis of its own"),
        (
            lambda: changed(stereo(), image=np.zeros((2, 3, 4, 5), np.uint8)),
            "shape 2x3x4x5 is no picture",
        ),
        (lambda: changed(stereo(), image=picture(0)[:0]), "empty picture"),
        (
            lambda: changed(stereo(), image=picture(0)[:12]),
            "the picture is 32x12, its camera 32x24",
        ),
        (
            lambda: changed(stereo(), right=picture(0)[:12]),
            "the right picture is 32x12, its camera 32x24",
        ),
        (lambda: changed(stereo(), right=None), "right is missing"),
        (lambda: changed(stereo(), rig=None), "rig is missing"),
        (
            lambda: changed(
                stereo(), camera=topoloc.Camera.pinhole(WIDTH, HEIGHT, 41.0, 41.0, 15.5, 11.5)
            ),
            r"rig\.left",
        ),
        (
            lambda: changed(stereo(), t_ns=0.1),
            r"integer nanoseconds, not 0\.1; of seconds: round\(seconds \* 1e9\)",
        ),
        (lambda: changed(stereo(), t_ns=True), "integer nanoseconds, not True"),
        (lambda: changed(rgbd(), world_from_cam=np.eye(4)), r"Rigid3\.from_matrix\(matrix\)"),
        (lambda: changed(rgbd(), depth=DEPTH.depth), r"a DepthImage\(depth, camera\), not ndarray"),
        (
            lambda: changed(rgbd(), depth=depth_of(np.full((HEIGHT, WIDTH), 2000, np.uint16))),
            r"in metres.*astype\(np\.float32\) / 1000",
        ),
        (
            lambda: changed(rgbd(), depth=depth_of(DEPTH.depth * 1000)),
            "a median depth of 2000 m .*; 1000 times the depth_factor",
        ),
        (
            lambda: changed(rgbd(), depth=depth_of(DEPTH.depth / 1000)),
            "a median depth of 0.002 m .*; the depth_factor divided by 1000",
        ),
        (
            lambda: changed(rgbd(), depth=depth_of(DEPTH.depth[:3])),
            "the depth image is 32x3.* rescaled",
        ),
        (lambda: "a path", "a StereoFrame is expected, not str"),
    ],
)
def test_invalid_frames_are_refused(frame: Callable[[], Any], says: str):
    with pytest.raises(RecordingError, match=f"memory, frame 1.*{says}") as raised:
        topoloc.MemorySequence(
            one for one in (changed(rgbd(0), t_ns=-1), frame())
        )  # the tests' own checks look into lists
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        ([0, 1, 2], "3 frames within 2 ns; t_ns counts nanoseconds"),
        ([0, 33, 66], "3 frames within 66 ns"),
        ([0, 100_000_000, 100_000_000], "t_ns 100000000 is not after the one before"),
        ([5, 4, 100_000_000], "t_ns 4 is not after the one before, 5"),
    ],
)
def test_invalid_times_are_refused(times: list[int], says: str):
    with pytest.raises(RecordingError, match=f"memory: {says}"):
        topoloc.MemorySequence(
            [changed(stereo(index), t_ns=t_ns) for index, t_ns in enumerate(times)]
        )


def test_no_frames_and_pictures_of_several_shapes():
    with pytest.raises(RecordingError, match="memory: no frames"):
        topoloc.MemorySequence([])
    frames = [
        topoloc.StereoFrame(f"{k}", k * 10**9, picture(k, 1, 32, 24 + k), None) for k in range(2)
    ]
    with pytest.raises(
        RecordingError,
        match=r"frame 1 \(1\): its picture is of another size than the first frame's",
    ):
        topoloc.MemorySequence(frames)


def test_numpy_integers_are_times():
    assert topoloc.MemorySequence([changed(stereo(), t_ns=np.int64(7))]).t_ns == [7]


@pytest.mark.parametrize(
    "image", [picture(0), picture(0, 3), picture(0, 3)[:, ::-1], np.asfortranarray(picture(0, 3))]
)
def test_pictures_that_are_good(image: np.ndarray):
    assert find_image_problem(image) is None
