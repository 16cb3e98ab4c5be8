"""Test TF: look-ups along the tree at a time, waiting, and broken trees."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from topoloc.apps.formats.bags.messages import StampedTransform
from topoloc.apps.robots.transform_buffer import TransformBuffer, TransformError
from topoloc.geometry.rigid import Rigid3

SECOND = 1_000_000_000


def _stamped(t_s: float, parent: str, child: str, pose: Rigid3) -> StampedTransform:
    w, x, y, z = pose.quat_wxyz().tolist()
    place = (float(pose.translation[0]), float(pose.translation[1]), float(pose.translation[2]))
    return StampedTransform(round(t_s * SECOND), parent, child, place, (x, y, z, w))


def _moving(t_s: float) -> Rigid3:
    return Rigid3.exp(np.array([t_s, 0.0, 0.0, 0.0, 0.0, 0.1 * t_s]))


MOUNT = Rigid3.exp(np.array([0.1, 0.2, 0.3, 0.0, 0.5, 0.0]))
LENS = Rigid3.exp(np.array([0.0, 0.0, 0.01, 1.2, 0.0, 0.0]))


@pytest.fixture
def buffer() -> TransformBuffer:
    tf = TransformBuffer()
    tf.add([_stamped(0.1 * k, "odom", "base", _moving(0.1 * k)) for k in range(21)], False)
    static = [_stamped(0.0, "base", "mount", MOUNT), _stamped(0.0, "mount", "camera", LENS)]
    tf.add(static, True)
    return tf


def test_a_chain_is_composed_at_the_time(buffer: TransformBuffer):
    between = _moving(1.0).interpolate(_moving(1.1), 0.5)
    found = buffer.look_up("odom", "camera", round(1.05 * SECOND))
    assert np.allclose(found.matrix(), (between @ MOUNT @ LENS).matrix(), atol=1e-9)
    back = buffer.look_up("camera", "odom", round(1.05 * SECOND))
    assert np.allclose((found @ back).matrix(), np.eye(4), atol=1e-9)
    static = buffer.look_up("base", "camera", 99 * SECOND)
    assert np.allclose(static.matrix(), (MOUNT @ LENS).matrix(), atol=1e-9)


def test_siblings_meet_at_their_common_frame(buffer: TransformBuffer):
    buffer.add([_stamped(0.0, "base", "lidar", LENS)], True)
    found = buffer.look_up("lidar", "camera", 5 * SECOND)
    assert np.allclose(found.matrix(), (LENS.inverse() @ MOUNT @ LENS).matrix(), atol=1e-9)


def test_it_waits_for_a_later_transform(buffer: TransformBuffer):
    later = [_stamped(2.1, "odom", "base", _moving(2.1))]
    threading.Timer(0.1, buffer.add, (later, False)).start()
    with pytest.raises(TransformError, match=r"the newest is 0\.05 s older"):
        buffer.look_up("odom", "camera", round(2.05 * SECOND))
    buffer.look_up("odom", "camera", round(2.05 * SECOND), wait_s=10.0)


def test_it_waits_no_longer_than_it_may(buffer: TransformBuffer):
    since = time.monotonic()
    with pytest.raises(TransformError, match="from odom to base at the time of the image"):
        buffer.look_up("odom", "camera", 3 * SECOND, wait_s=0.2)
    assert 0.2 <= time.monotonic() - since < 5.0


def test_missing_frames_are_named(buffer: TransformBuffer):
    with pytest.raises(TransformError, match="no frame lens in TF; TF has base, camera"):
        buffer.look_up("odom", "lens", SECOND)
    with pytest.raises(TransformError, match="TF is empty"):
        TransformBuffer().look_up("odom", "lens", SECOND)
    buffer.add([_stamped(0.0, "arm", "hand", LENS)], True)
    with pytest.raises(TransformError, match="TF does not connect odom to hand"):
        buffer.look_up("odom", "hand", SECOND)
    with pytest.raises(TransformError, match="all are newer"):
        buffer.look_up("odom", "camera", -SECOND)


def test_a_loop_is_named_and_not_followed(buffer: TransformBuffer):
    buffer.add([_stamped(1.0, "camera", "odom", LENS)], False)
    with pytest.raises(TransformError, match=r"TF loops: .*camera.* in .*odom"):
        buffer.look_up("odom", "camera", SECOND)


def test_only_the_last_seconds_are_kept(buffer: TransformBuffer):
    buffer.add([_stamped(11.0, "odom", "base", _moving(11.0))], False)
    with pytest.raises(TransformError, match="all are newer"):
        buffer.look_up("odom", "base", round(0.5 * SECOND))
    buffer.look_up("odom", "base", round(1.5 * SECOND))


def test_a_clock_set_back_starts_again(buffer: TransformBuffer):
    buffer.add([_stamped(30.0, "odom", "base", _moving(1.0))], False)
    buffer.add([_stamped(1.0 + 0.1 * k, "odom", "base", _moving(2.0)) for k in range(2)], False)
    found = buffer.look_up("odom", "base", round(1.05 * SECOND))
    assert np.allclose(found.matrix(), _moving(2.0).matrix())


def test_transforms_out_of_order_are_put_in_order():
    tf = TransformBuffer()
    tf.add([_stamped(t, "odom", "base", _moving(t)) for t in (0.2, 0.0, 0.1, 0.1)], False)
    found = tf.look_up("odom", "base", round(0.1 * SECOND))
    assert np.allclose(found.matrix(), _moving(0.1).matrix())


def test_a_frame_that_gets_another_parent_forgets_the_first(buffer: TransformBuffer):
    buffer.add([_stamped(0.0, "base", "camera", LENS)], True)
    found = buffer.look_up("base", "camera", SECOND)
    assert np.allclose(found.matrix(), LENS.matrix())
