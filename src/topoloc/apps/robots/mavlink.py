"""Send poses to an autopilot (PX4, ArduPilot) as MAVLink 2 ODOMETRY over UDP.

The map is level (`topoloc level`): its z axis points up. Its frame and that of the body are x
forward, y left, z up here, and x forward, y right, z down on the wire (MAV_FRAME_LOCAL_FRD,
MAV_FRAME_BODY_FRD). Whoever publishes repeats the last pose at 10 Hz or more, which estimators of
autopilots expect.

Only poses that images measured are sent. A pose that does not continue the last one must be
confirmed by the images after it, and is then announced as a reset.
"""

from __future__ import annotations

import math
import re
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from jaxtyping import Float

from topoloc import Localization, Rigid3, StreamedPose, TopolocError
from topoloc.apps.robots.map_to_odom import ContinuityGate

_ADDRESS = re.compile(r"udp(in|out):(\[[^\]]+\]|[^:\[\]]+):([0-9]{1,5})")


def body_of_forward_camera(map_from_cam: Rigid3) -> Rigid3:
    """Return the pose of a body that looks where its camera does, at the camera's position."""
    cam_from_body = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    return map_from_cam @ Rigid3(cam_from_body, np.zeros(3))


def encode_odometry(
    t_ns: int,
    map_from_body: Rigid3,
    covariance: Float[np.ndarray, "6 6"],
    p: float | None,
    reset_counter: int,
) -> bytes:
    """Return the payload of ODOMETRY with its extension fields.

    Args:
        t_ns: time of the image, nanoseconds since 1970 or since the start of the system.
        covariance: that of `Localization`. It is the same for camera and body.
        p: probability of the pose. Its percentage is the quality, 1 at least; None is 0, unknown.
        reset_counter: number of jumps of the pose, modulo 256.
    """
    turn = np.array([1.0, -1.0, -1.0])  # half a turn about x, from z up to z down
    position = map_from_body.translation * turn
    quaternion = map_from_body.quat_wxyz() * np.array([1.0, *turn])
    about_body = Rigid3(np.eye(3), -map_from_body.translation).transform_covariance(covariance)
    turned = about_body * np.outer(np.tile(turn, 2), np.tile(turn, 2))
    velocities, unknown = [math.nan] * 6, [math.nan] + [0.0] * 20
    parts = (position, quaternion, velocities, turned[np.triu_indices(6)], unknown)
    numbers = np.concatenate(parts) + 0.0  # no negative zeros
    quality = 0 if p is None else max(1, round(100.0 * p))
    # frames LOCAL_FRD and BODY_FRD, and an estimator by vision
    kinds = (20, 12, reset_counter % 256, 2, quality)
    return struct.pack("<Q55f4Bb", t_ns // 1000, *numbers, *kinds)


def encode_frame(payload: bytes, sequence: int, message_id: int = 331, extra: int = 91) -> bytes:
    """Return a MAVLink 2 frame of the visual odometry (component 197) of system 1.

    Zeros at the end of the payload are not sent. `extra` is the CRC_EXTRA of the message.
    """
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    head = struct.pack("<6B", len(payload), 0, 0, sequence % 256, 1, 197)
    content = head + message_id.to_bytes(3, "little") + payload
    return b"\xfd" + content + struct.pack("<H", _checksum(content + bytes([extra])))


def _checksum(data: bytes) -> int:
    """Return CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        byte ^= crc & 0xFF
        byte ^= (byte << 4) & 0xFF
        crc = (crc >> 8) ^ (byte << 8) ^ (byte << 3) ^ (byte >> 4)
    return crc


class MavlinkPublisher:
    """Sends ODOMETRY to `udpout:HOST:PORT`, or to whoever wrote last to `udpin:HOST:PORT`, the own
    port. Raises TopolocError: the address is malformed or unknown, or its port is in use."""

    def __init__(self, address: str) -> None:
        parts = _ADDRESS.fullmatch(address)
        if parts is None or not 0 < int(parts[3]) < 65_536:
            raise TopolocError(
                f"{address[:80]}: a MAVLink address is udpout:HOST:PORT or udpin:HOST:PORT"
            )
        host, port = parts[2].strip("[]"), int(parts[3])
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            if parts[1] == "in":
                self._socket.bind(found[4])
        except OSError as error:
            fault = error.strerror or error
            raise TopolocError(f"{address[:80]}: {fault}; name another host or port") from None
        self._address, self._sequence, self._num_resets = address, 0, 0
        self._is_asked, self._receiver = parts[1] == "in", None if parts[1] == "in" else found[4]

    def publish(
        self,
        t_ns: int,
        map_from_body: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        p: float | None,
        is_reset: bool = False,
    ) -> None:
        """Send a pose. `is_reset`: it does not continue the last one, as after a loss. See
        `encode_odometry` for the rest. Raises TopolocError: there is no network."""
        self._num_resets += is_reset
        with suppress(BlockingIOError, ConnectionResetError):  # nobody has written since
            while self._is_asked:
                self._receiver = self._socket.recvfrom(300)[1]
        payload = encode_odometry(t_ns, map_from_body, covariance, p, self._num_resets)
        frame = encode_frame(payload, self._sequence)
        self._sequence += 1
        if self._receiver is None:
            return
        try:
            self._socket.sendto(frame, self._receiver)
        except BlockingIOError:  # the next pose takes its place
            pass
        except OSError as error:
            raise TopolocError(f"{self._address}: {error.strerror or error}") from None

    def close(self) -> None:
        self._socket.close()


class DroneLocalizer:
    """Sends the poses of a stream of images of a camera that looks ahead, until it is closed.
    `warn` gets one line if they cannot be sent."""

    def __init__(self, address: str, warn: Callable[[str], None]) -> None:
        self._publisher, self._warn = MavlinkPublisher(address), warn
        self._last: Localization | None = None  # as sent
        self._last_ns, self._received, self._gate = 0, 0.0, ContinuityGate()
        self._lock, self._is_closed = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="mavlink", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sending."""
        self._is_closed.set()
        self._thread.join(1.0)
        self._publisher.close()

    def take(self, answer: StreamedPose) -> None:
        """Take the answer for an image. It is sent if it is measured, probable, and continues the
        last pose or is confirmed."""
        min_probability, result = 0.8, answer.result
        if not isinstance(result, Localization) or answer.is_repeated:
            return
        if result.probability < min_probability:
            return
        verdict, is_first = self._gate.judge(answer.t_ns, result.world_from_cam), self._last is None
        if verdict == "doubted":
            return
        with self._lock:
            self._last, self._last_ns = result, answer.t_ns
            self._received = time.monotonic()
            self._send(is_reset=verdict == "jumped" and not is_first)

    def _send(self, is_reset: bool) -> None:
        if self._last is None:
            return
        body = body_of_forward_camera(self._last.world_from_cam)
        covariance, p = self._last.covariance, self._last.probability
        try:
            self._publisher.publish(self._last_ns, body, covariance, p, is_reset)
        except TopolocError as error:
            self._warn(str(error))
            self._is_closed.set()

    def _repeat(self) -> None:
        """Send the last pose again while it is new; runs in the thread."""
        interval, max_age = 0.08, 0.5  # seconds
        while not self._is_closed.wait(interval):
            with self._lock:
                if self._last is not None and time.monotonic() - self._received < max_age:
                    self._send(is_reset=False)
