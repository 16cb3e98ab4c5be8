"""Test the selection of a video's key frames: their distance, and sharp ones among blurred."""

from __future__ import annotations

import cv2
import numpy as np

import tiny_world
from topoloc.apps.reconstruction.key_frames import select_key_frames
from topoloc.recordings.frame import MemorySequence, StereoFrame, StereoSequence

WIDTH, HEIGHT = 320, 240


def _video(shifts_px: list[int], is_blurred: list[bool] | None = None) -> StereoSequence:
    """Return frames that pan over one large picture."""
    picture = tiny_world.smooth_texture(3, (6.0, 2.0)).astype(np.uint8)
    blurred = cv2.GaussianBlur(picture, (0, 0), 2.0)
    flags = is_blurred or [False] * len(shifts_px)
    return MemorySequence(
        StereoFrame(f"{k:06d}", k * 10**8, image[:HEIGHT, shift : shift + WIDTH].copy(), None)
        for k, (shift, image) in enumerate(
            (shift, blurred if flag else picture)
            for shift, flag in zip(shifts_px, flags, strict=True)
        )
    )


def _select(sequence: StereoSequence, *always: str) -> list[int]:
    return [
        int(name)
        for name in select_key_frames(sequence, always, lambda stage, done, total: None).names
    ]


def test_sharp_frames_a_part_of_the_image_apart():
    is_blurred = [k % 2 == 1 for k in range(60)]
    rows = _select(_video([5 * k for k in range(60)], is_blurred))  # 1.6 % of the width a frame
    assert rows[0] == 0
    assert 8 <= len(rows) <= 16
    assert all(4 <= step <= 8 for step in np.diff(rows))
    assert not any(is_blurred[row] for row in rows)


def test_a_camera_that_stands_still_has_one():
    assert _select(_video([100] * 10)) == [0]


def test_named_frames_are_kept():
    assert _select(_video([100] * 10), "000004", "000007") == [0, 4, 7]


def test_a_jump_and_frames_without_texture_end_a_track():
    shifts = [0, 0, 0, 600, 600, 600]
    assert _select(_video(shifts)) == [0, 3]
    black = [StereoFrame(one.name, one.t_ns, 0 * one.image, None) for one in _video(shifts[:2])]
    assert _select(MemorySequence([*black, *_video(shifts)[2:]]))[1] == 2
