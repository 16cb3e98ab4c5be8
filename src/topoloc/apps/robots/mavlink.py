"""Send poses to an autopilot (PX4, ArduPilot) as MAVLink 2 ODOMETRY over UDP.

The map is level (`topoloc level`): its z axis points up. Its frame and that of the body are x
forward, y left, z up here, and x forward, y right, z down on the wire (MAV_FRAME_LOCAL_FRD,
MAV_FRAME_BODY_FRD). Whoever publishes repeats the last pose at 10 Hz or more, which estimators of
autopilots expect.

Only poses that images measured are sent. A pose that does not continue the last one must be
confirmed by the images after it, and is then announced as a reset. HEARTBEAT names the sender, and
TIMESYNC of the autopilot is answered with the clock of live images.
"""

from __future__ import annotations

import math
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from jaxtyping import Float

from topoloc import Localization, Rigid3, StreamedPose, TopolocError
from topoloc.apps.robots.map_to_odom import ContinuityGate, StreamPose

# Number of a message and its CRC_EXTRA.
_HEARTBEAT, _TIMESYNC, _ODOMETRY = (0, 50), (111, 34), (331, 91)
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


def encode_frame(
    payload: bytes,
    sequence: int,
    message_id: int = _ODOMETRY[0],
    extra: int = _ODOMETRY[1],
) -> bytes:
    """Return a MAVLink 2 frame of the visual odometry (component 197) of system 1.

    Zeros at the end of the payload are not sent. `extra` is the CRC_EXTRA of the message.
    """
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    head = struct.pack("<6B", len(payload), 0, 0, sequence % 256, 1, 197)
    content = head + message_id.to_bytes(3, "little") + payload
    return b"\xfd" + content + struct.pack("<H", _checksum(content + bytes([extra])))


def encode_heartbeat() -> bytes:
    """Return the payload of HEARTBEAT: an active onboard controller that is no autopilot."""
    return struct.pack("<I5B", 0, 18, 8, 0, 4, 3)


def read_timesync(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield tc1 and ts1 (nanoseconds) of each whole TIMESYNC in a datagram of MAVLink 1 or 2."""
    message_id, extra = _TIMESYNC
    at = 0
    while len(data) - at >= 8:
        is_2, length = data[at] == 0xFD, data[at + 1]
        head, signature = (10, 13 * (data[at + 2] & 1)) if is_2 else (6, 0)
        end = at + head + length
        if data[at] not in (0xFD, 0xFE) or end + 2 > len(data):
            at += 1
            continue
        number = int.from_bytes(data[at + 7 : at + 10], "little") if is_2 else data[at + 5]
        content = data[at + 1 : end] + bytes([extra])
        checksum = int.from_bytes(data[end : end + 2], "little")
        if number == message_id and checksum == _checksum(content):
            yield struct.unpack("<qq", data[at + head : end].ljust(16, b"\0")[:16])
        at = end + 2 + signature


def _checksum(data: bytes) -> int:
    """Return CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        byte ^= crc & 0xFF
        byte ^= (byte << 4) & 0xFF
        crc = (crc >> 8) ^ (byte << 8) ^ (byte << 3) ^ (byte >> 4)
    return crc


class MavlinkPublisher:
    """Sends messages to `udpout:HOST:PORT`, or to whoever wrote last to `udpin:HOST:PORT`, the own
    port. Threads may share it. Raises TopolocError: the address is malformed or unknown, or its
    port is in use."""

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
        self._lock = threading.Lock()

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
        self.answer()
        self._send(encode_odometry(t_ns, map_from_body, covariance, p, self._num_resets), _ODOMETRY)

    def send_heartbeat(self) -> None:
        """Send HEARTBEAT, which autopilots expect each second. Raises TopolocError: no network."""
        self._send(encode_heartbeat(), _HEARTBEAT)

    def answer(self, wait_s: float = 0.0) -> None:
        """Read what has arrived, or arrives within `wait_s`, and answer requests of TIMESYNC with
        this machine's time. Raises TopolocError: there is no network."""
        with suppress(OSError, ValueError):
            select.select([self._socket], [], [], wait_s)
        arrived = list[tuple[int, int]]()
        with suppress(OSError):  # BlockingIOError at the end, or nobody listens there
            while True:
                data, sender = self._socket.recvfrom(2048)
                self._receiver = sender if self._is_asked else self._receiver
                arrived += read_timesync(data)
        for theirs, ours in arrived:
            if theirs == 0:  # a request; others are answers
                self._send(struct.pack("<qq", time.time_ns(), ours), _TIMESYNC)

    def close(self) -> None:
        self._socket.close()

    def _send(self, payload: bytes, kind: tuple[int, int]) -> None:
        with self._lock:
            frame, self._sequence = encode_frame(payload, self._sequence, *kind), self._sequence + 1
        if self._receiver is None:
            return
        try:
            self._socket.sendto(frame, self._receiver)
        except (BlockingIOError, ConnectionError):  # the next one takes its place
            pass
        except OSError as error:
            raise TopolocError(f"{self._address}: {error.strerror or error}") from None


class DroneLocalizer:
    """Sends the poses of a stream of images of a camera that looks ahead, until it is closed.

    Args:
        warn: gets one line if they cannot be sent.
        origin: point of the map's world that is sent as 0, metres.
    """

    def __init__(
        self,
        address: str,
        warn: Callable[[str], None],
        origin: Float[np.ndarray, "3"] | None = None,
    ) -> None:
        self._publisher, self._warn = MavlinkPublisher(address), warn
        self._sent_from_map = Rigid3(np.eye(3), np.zeros(3) if origin is None else -origin)
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
        last pose or is confirmed. Raises MapError: it is of a map without scale."""
        min_probability, result = 0.8, answer.result
        result.provenance.require_scale("a drone")
        self._gate.observe(answer)
        if not (isinstance(result, Localization) and answer.is_measured):
            return
        if result.probability < min_probability:
            return
        seen = answer.t_ns, result.world_from_cam, result.position_sigma_m, answer.track
        verdict, is_first = self._gate.judge(StreamPose(*seen)), self._last is None
        if verdict == "doubted":
            return
        with self._lock:
            self._last, self._last_ns = result, answer.t_ns
            self._received = time.monotonic()
            self._try(lambda: self._send(is_reset=verdict == "jumped" and not is_first))

    def _send(self, is_reset: bool) -> None:
        if self._last is None:
            return
        body = self._sent_from_map @ body_of_forward_camera(self._last.world_from_cam)
        covariance = self._sent_from_map.transform_covariance(self._last.covariance)
        numbers = covariance, self._last.probability, is_reset
        self._publisher.publish(self._last_ns, body, *numbers)

    def _try(self, send: Callable[[], None]) -> None:
        try:
            send()
        except TopolocError as error:
            if not self._is_closed.is_set():
                self._warn(str(error))
            self._is_closed.set()

    def _repeat(self) -> None:
        """Send the last pose again while it is new, answer and live; runs in the thread."""
        interval, max_age, beat = 0.08, 0.5, 1.0  # seconds
        due = beat_due = 0.0
        while not self._is_closed.is_set():
            self._try(lambda: self._publisher.answer(interval))
            now = time.monotonic()
            if now >= beat_due:
                beat_due = now + beat
                self._try(self._publisher.send_heartbeat)
            if now < due:
                continue
            due = now + interval
            with self._lock:
                if self._last is not None and now - self._received < max_age:
                    self._try(lambda: self._send(is_reset=False))


def choose_origin(
    positions: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "3"] | None:
    """Return a point near these positions (metres) that is to be sent as 0, a multiple of a
    kilometre. None if they are so near to 0 that numbers of 32 bits hold millimetres."""
    near, step = 10_000.0, 1000.0  # metres
    if not len(positions) or np.abs(positions).max() < near:
        return None
    return np.round(positions.mean(axis=0) / step) * step
