"""Check that MAVLink frames equal pymavlink 2.4.50 byte for byte, in the axes and angles
of an autopilot."""

from __future__ import annotations

import math
import struct
import time

import numpy as np
import pytest

from heard_autopilot import receiver
from topoloc.apps.robots.mavlink import (
    DroneLocalizer,
    MavlinkPublisher,
    body_of_forward_camera,
    encode_frame,
    encode_heartbeat,
    encode_odometry,
    read_timesync,
)
from topoloc.errors import TopolocError
from topoloc.geometry.rigid import Rigid3, exp_so3

# MAVLink_odometry_message(...).pack() of pymavlink 2.4.50, system 1, component 197. In the order of
# `CASES`.
GOLDEN = [
    (
        "fde900000001c54b010000401e18240a06000000803f000000c0000040c00000803f00000000000000000000"
        "00000000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000803e0000000000000000000000000000"
        "0000000000000000003f000000000000000000000000000000000000803f0000000000000000000000000000"
        "000000000000000000000000000000000000000000000000c07f000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "000000000000000000000000000000000000140c000261884d"
    ),
    (
        "fde90000ff01c54b01000500000000000000000000000000000000000000f304353f0000000000000000f304"
        "35bf0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "000000000000000000000000000000000000000000000000c07f000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "000000000000000000000000000000000000140cff0201d04c"
    ),
    (
        "fde800000701c54b010000000000000000000000000000000000000000000000803f00000000000000000000"
        "00000000c07f0000c07f0000c07f0000c07f0000c07f0000c07f000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "000000000000000000000000000000000000000000000000c07f000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "000000000000000000000000000000000000140c00020b8e"
    ),
    (
        "fde900000101c54b010000000000000020000000003f000000400000a0bf0000003f0000003f000000bf0000"
        "00bf0000c07f0000c07f0000c07f0000c07f0000c07f0000c07f00001441000000bf000040bf0000803f0000"
        "a0bf0000c0bf000020410000c03f000000c0000020400000404000003441000040c000007040000090400000"
        "50410000a0c00000c0c0000074410000f040000090410000c07f000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "000000000000000000000000000000000000140c030264e364"
    ),
]

_COVARIANCE = 9.0 * np.eye(6) + 0.25 * np.outer(np.arange(1.0, 7.0), np.arange(1.0, 7.0))


def _pose(rotation: np.ndarray, *position: float) -> Rigid3:
    return Rigid3(rotation, np.array(position, float))


def _about_origin(pose: Rigid3, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance of the left perturbation, given the covariance about the body."""
    return Rigid3(np.eye(3), pose.translation).transform_covariance(covariance)


_AT = _pose(np.eye(3), 1.0, 2.0, 3.0)
_CYCLED = Rigid3.from_quat_wxyz(np.full(4, 0.5), np.array([0.5, -2.0, 1.25]))
_LEFT = _pose(exp_so3(np.array([0.0, 0.0, math.pi / 2])), 0.0, 0.0, 0.0)
_NONE = np.zeros((6, 6))
CASES = [
    (0, 1_700_000_000_000_000_999, _AT, np.diag([0.25, 0.5, 1.0, 0.0, 0.0, 0.0]), 0.97, 0),
    (255, 5_000, _LEFT, _NONE, 0.001, 255),
    (7, 0, Rigid3.identity(), _NONE, None, 256),
    (1, 2**53 * 1000, _CYCLED, _about_origin(_CYCLED, _COVARIANCE), 1.0, 3),
]


@pytest.mark.parametrize("number", range(len(CASES)))
def test_frames_are_those_of_pymavlink(number: int):
    sequence, *values = CASES[number]
    assert encode_frame(encode_odometry(*values), sequence).hex() == GOLDEN[number]


@pytest.mark.parametrize("number", range(len(CASES)))
def test_pymavlink_reads_them(number: int):
    common = pytest.importorskip(
        "pymavlink.dialects.v20.common", reason="pymavlink (LGPL) is not installed"
    )
    sequence, *values = CASES[number]
    message = common.MAVLink(None).decode(
        bytearray(encode_frame(encode_odometry(*values), sequence))
    )
    assert message.get_type() == "ODOMETRY"
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 197)
    assert (message.frame_id, message.child_frame_id, message.estimator_type) == (20, 12, 2)
    assert message.time_usec == values[0] // 1000
    assert message.reset_counter == values[4] % 256
    assert math.isnan(message.vx)
    assert math.isnan(message.yawspeed)
    assert math.isnan(message.velocity_covariance[0])


def _crc(content: bytes, extra: int) -> bytes:
    """Return the two bytes of CRC-16/MCRF4XX, bit by bit."""
    crc = 0xFFFF
    for byte in content + bytes([extra]):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


@pytest.mark.parametrize("is_signed", [False, True])
def test_requests_of_timesync_are_read_among_others(is_signed: bool):
    request = struct.pack("<qq", 0, 1_700_000_000_123_456_789)
    frame = bytearray(encode_frame(request, 3, 111, 34))
    assert frame[1] == 16, "zeros at the start are sent"
    if is_signed:
        content = b"\xfd\x10\x01" + bytes(frame[3:-2])
        frame = bytearray(content + _crc(content[1:], 34) + bytes(13))
    old = b"\xfe\x10\x00\x01\x01\x6f" + request
    old += _crc(old[1:], 34)
    heartbeat = encode_frame(encode_heartbeat(), 4, 0, 50)
    damaged = bytes(frame[:12]) + bytes([frame[12] ^ 1]) + bytes(frame[13:])
    mixed = b"\x00\xfd" + heartbeat + bytes(frame) + damaged + old + heartbeat[:7]
    ours = (0, 1_700_000_000_123_456_789)
    assert list(read_timesync(mixed)) == [ours, ours]


def test_pymavlink_reads_heartbeat_and_timesync():
    common = pytest.importorskip(
        "pymavlink.dialects.v20.common", reason="pymavlink (LGPL) is not installed"
    )
    link = common.MAVLink(None)
    beat = link.decode(bytearray(encode_frame(encode_heartbeat(), 0, 0, 50)))
    assert (beat.get_type(), beat.type, beat.autopilot) == ("HEARTBEAT", 18, 8)
    assert (beat.system_status, beat.mavlink_version) == (4, 3)
    request = common.MAVLink_timesync_message(0, 5_000_000_007).pack(link)
    assert list(read_timesync(bytes(request))) == [(0, 5_000_000_007)]
    assert bytes(request)[:7].hex()[:2] == "fd"


def test_timesync_is_answered_and_heartbeats_are_sent():
    """The answer has the clock of the images: nanoseconds since 1970."""
    with receiver() as autopilot:
        drone = DroneLocalizer(f"udpout:127.0.0.1:{autopilot.getsockname()[1]}", print)
        beat, sender = autopilot.recvfrom(300)
        before_ns = time.time_ns()
        autopilot.sendto(encode_frame(struct.pack("<qq", 0, 77), 0, 111, 34), sender)
        (answer,) = read_timesync(autopilot.recv(300))
        # an answer to somebody else's request is no request
        autopilot.sendto(encode_frame(struct.pack("<qq", 5, 77), 1, 111, 34), sender)
        after = autopilot.recv(300)
        drone.close()
    assert beat == encode_frame(encode_heartbeat(), 0, 0, 50)
    assert answer[1] == 77
    assert before_ns <= answer[0] <= time.time_ns()
    assert after[7:10] == bytes(3)  # the next HEARTBEAT


def _sent(pose: Rigid3, covariance: np.ndarray | None = None) -> tuple[np.ndarray, Rigid3]:
    """Return the covariance and the pose (forward, right, down) that an autopilot reads."""
    payload = encode_odometry(0, pose, _NONE if covariance is None else covariance, 0.5, 0)
    numbers = np.frombuffer(payload[8:228], "<f4").astype(float)
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = numbers[13:34]
    whole = upper + upper.T - np.diag(np.diag(upper))
    return whole, Rigid3.from_quat_wxyz(numbers[3:7], numbers[:3])


def test_forward_left_up_become_forward_right_down():
    _, pose = _sent(_pose(np.eye(3), 1.0, 2.0, 3.0))
    np.testing.assert_allclose(pose.translation, [1.0, -2.0, -3.0])
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-7)


@pytest.mark.parametrize(
    ("turned", "nose", "right_wing"),
    [
        ([0, 0, math.pi / 2], [0, -1, 0], [1, 0, 0]),  # to the left
        ([0, -math.pi / 4, 0], [math.sqrt(0.5), 0, -math.sqrt(0.5)], [0, 1, 0]),  # the nose up
        ([math.pi / 2, 0, 0], [1, 0, 0], [0, 0, 1]),  # the right wing down
    ],
)
def test_turns_are_those_of_an_aircraft(
    turned: list[float], nose: list[float], right_wing: list[float]
):
    _, pose = _sent(_pose(exp_so3(np.array(turned)), 0.0, 0.0, 0.0))
    np.testing.assert_allclose(pose.rotation[:, 0], nose, atol=1e-6)
    np.testing.assert_allclose(pose.rotation[:, 1], right_wing, atol=1e-6)


def test_a_camera_that_looks_forward_is_a_level_body():
    """The camera looks along x of the map: its right is -y, its down -z."""
    looks_forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    body = body_of_forward_camera(_pose(looks_forward, 4.0, 5.0, 6.0))
    assert body.is_same(_pose(np.eye(3), 4.0, 5.0, 6.0), 1e-12, 1e-12)


def test_the_covariance_is_that_of_poses_drawn_from_it():
    """Draw poses from the covariance of `Localization`, send them, and measure them about the body
    in autopilot axes."""
    pose = _pose(exp_so3(np.array([0.2, -0.4, 1.1])), 5.0, -3.0, 2.0)
    sigmas = np.array([0.02, 0.03, 0.01, 0.004, 0.002, 0.006])
    mixed = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    covariance = mixed @ np.diag(sigmas**2) @ mixed.T
    stated, mean = _sent(pose, covariance)
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance, 4000)
    errors = []
    for xi in drawn:
        _, one = _sent(Rigid3.exp(xi) @ pose)
        turned = Rigid3(one.rotation @ mean.rotation.T, np.zeros(3)).log()[3:]
        errors.append([*(one.translation - mean.translation), *turned])
    measured = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((measured - stated) / scale).max() < 0.08


@pytest.mark.parametrize(("p", "quality"), [(None, 0), (0.0, 1), (0.004, 1), (0.5, 50), (1.0, 100)])
def test_quality_is_the_percentage_and_0_is_unknown(p: float | None, quality: int):
    assert encode_odometry(0, Rigid3.identity(), _NONE, p, 0)[-1] == quality


def test_poses_are_sent_and_jumps_are_counted():
    with receiver() as heard:
        publisher = MavlinkPublisher(f"udpout:localhost:{heard.getsockname()[1]}")
        for number, is_reset in enumerate((False, True, False, True)):
            publisher.publish(1000 * number, Rigid3.identity(), _NONE, 0.9, is_reset)
        frames = [heard.recv(300) for _ in range(4)]
        publisher.close()
    expected = [
        encode_frame(encode_odometry(1000 * number, Rigid3.identity(), _NONE, 0.9, resets), number)
        for number, resets in enumerate((0, 1, 1, 2))
    ]
    assert frames == expected


def test_an_own_port_sends_to_its_clients():
    with receiver() as free:
        port = free.getsockname()[1]
    publisher = MavlinkPublisher(f"udpin:127.0.0.1:{port}")
    publisher.publish(0, Rigid3.identity(), _NONE, 0.9)  # no receiver is connected yet
    with receiver() as heard:
        heard.sendto(b"\xfd", ("127.0.0.1", port))
        publisher.publish(1000, Rigid3.identity(), _NONE, 0.9)
        assert heard.recv(300)[4] == 1, "the second frame"
    with pytest.raises(TopolocError, match=f"^udpin:127.0.0.1:{port}: [^\n]*in use; name another"):
        MavlinkPublisher(f"udpin:127.0.0.1:{port}")
    publisher.close()


@pytest.mark.parametrize(
    "address",
    ["", "udpout", "udpout:localhost", "udpout:localhost:0", "udpout:localhost:70000",
     "udpout::14550", "tcp:localhost:5760", "udpout:localhost:14550x", "udpout:a:b:14550"],
)  # fmt: skip
def test_an_invalid_address_is_one_sentence(address: str):
    with pytest.raises(TopolocError, match="a MAVLink address is udpout:HOST:PORT or udpin"):
        MavlinkPublisher(address)


def test_a_host_that_is_unknown_is_named():
    with pytest.raises(TopolocError, match=r"^udpout:nowhere\.invalid:14550: "):
        MavlinkPublisher("udpout:nowhere.invalid:14550")
