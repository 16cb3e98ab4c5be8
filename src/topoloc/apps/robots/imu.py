"""Read the gyroscope of an IMU, from a CSV file or a topic of ROS 2, beside a stream of images."""

from __future__ import annotations

import csv
import math
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc import CalibrationError, Gyroscope, RecordingError, Rigid3
from topoloc.apps.cli.queries.query_answers import QueryFrame
from topoloc.apps.core_names import parse_times
from topoloc.apps.formats.bags.messages import stamp_ns
from topoloc.apps.robots.ros_images import topic_of
from topoloc.apps.robots.ros_node import RosNode
from topoloc.plugin import read_text

Sample = tuple[int, Float[np.ndarray, "3"]]
"""Time, nanoseconds, and angular velocity in the axes of the IMU, rad/s."""
_AXIS = re.compile(r"(?P<kind>.*?)[ _.]?(?P<axis>[xyz])")
_KINDS = re.compile(r"|g|w|gyr.*|w_rs_s|omega|.*rotationrate|.*ang\w*[ _.]?vel\w*|.*gyro\w*")
_AHEAD_NS = 50_000_000  # samples up to so long after an image belong to it


class ImuFeed:
    """Give a gyroscope its samples while images are localized, and report what becomes of it.

    Args:
        take: returns the new samples up to a time.
        report: gets one line when the images confirm the gyroscope.
        warn: gets one line when they contradict it.
    """

    def __init__(
        self,
        name: str,
        gyroscope: Gyroscope,
        take: Callable[[int], Iterable[Sample]],
        report: Callable[[str], None],
        warn: Callable[[str], None],
    ) -> None:
        self._name, self._gyroscope, self._take = name, gyroscope, take
        self._report, self._warn, self._is_reported = report, warn, False

    def feed(self, frames: Iterable[QueryFrame]) -> Iterator[QueryFrame]:
        """Yield the frames, each after the samples up to its time."""
        for frame in frames:
            for t_ns, rate in self._take(frame.t_ns + _AHEAD_NS):
                self._gyroscope.add(t_ns, rate)
            yield frame
            if not self._is_reported:
                self._report_state()

    def _report_state(self) -> None:
        gyroscope = self._gyroscope
        if gyroscope.fault is not None:
            self._warn(f"{self._name}: the gyroscope is not used: {gyroscope.fault}")
            self._is_reported = True
        elif gyroscope.cam_from_imu is not None:
            quat = Rigid3(gyroscope.cam_from_imu, np.zeros(3)).quat_wxyz()
            bias = " ".join(f"{value:.2f}" for value in np.degrees(gyroscope.bias))
            self._report(
                f"{self._name}: the images confirm the gyroscope; --cam-from-imu"
                f" {','.join(f'{value:.4f}' for value in quat)}, bias {bias} deg/s"
            )
            self._is_reported = True


def make_gyroscope(cam_from_imu: str | None) -> Gyroscope:
    """Return a gyroscope without samples. `cam_from_imu` is its rotation, `w,x,y,z`. Raises
    CalibrationError: it is no rotation."""
    if cam_from_imu is None:
        return Gyroscope()
    values = cam_from_imu.split(",")
    quat = np.array([float(value) if _is_number(value) else np.nan for value in values])
    if len(quat) != 4 or not 0.9 < np.linalg.norm(quat) < 1.1:
        raise CalibrationError(
            f"--cam-from-imu {cam_from_imu[:60]}: no rotation; a quaternion w,x,y,z of length 1 is"
            " expected"
        )
    return Gyroscope(Rigid3.from_quat_wxyz(quat, np.zeros(3)).rotation)


def take_from_file(path: Path) -> Callable[[int], Iterable[Sample]]:
    """Return the `take` of a file. It raises RecordingError: the first image is not in its time."""
    samples, at = read_imu(path), 0

    def take(until_ns: int) -> list[Sample]:
        nonlocal at
        start, image_ns = at, until_ns - _AHEAD_NS
        first, last = samples[0][0], samples[-1][0]
        if at == 0 and not first - 10_000_000_000 <= image_ns <= last:
            raise RecordingError(
                f"{path}: its times, {first / 1e9:.3f} to {last / 1e9:.3f} s, do not hold the"
                f" first image's, {image_ns / 1e9:.3f} s; give both the times of one clock"
            )
        while at < len(samples) and samples[at][0] <= until_ns:
            at += 1
        return samples[start:at]

    return take


def take_from_topic(node: RosNode, source: str) -> Callable[[int], Iterable[Sample]]:
    """Return the `take` of a topic with sensor_msgs/Imu, such as `ros:/imu`. Raises RecordingError:
    it is no topic."""
    arrived = deque[Sample](maxlen=12_000)  # half a minute

    def hear(message: Any) -> None:
        rate = message.angular_velocity
        arrived.append((stamp_ns(message.header.stamp), np.array([rate.x, rate.y, rate.z])))

    def take(until_ns: int) -> Iterator[Sample]:
        while arrived:
            yield arrived.popleft()

    node.create_reader(topic_of(source, "imu"), node.messages.Imu, "sensor", hear)
    return take


def read_imu(path: Path) -> list[Sample]:
    """Read times and angular velocities from a CSV file: EuRoC's (`#timestamp [ns],w_RS_S_x ...`)
    or that of a phone's logger. Columns are found by their names. A file without names has time, x,
    y and z. Rates are in rad/s, or in deg/s if the names say so.

    Raises:
        RecordingError: the file cannot be read, it has no columns of a gyroscope, or a value is no
            number. Names file and line.
    """
    text = read_text(path, RecordingError)
    delimiter = ";" if text.partition("\n")[0].count(";") > 2 else ","
    rows = [
        (number, [value.strip() for value in row])
        for number, row in enumerate(csv.reader(text.splitlines(), delimiter=delimiter), start=1)
        if any(value.strip() for value in row)
    ]
    names = [] if not rows or _is_number(rows[0][1][0]) else [one.lower() for one in rows[0][1]]
    columns, unit = _find_columns(names, path) if names else ([0, 1, 2, 3], 1.0)
    chosen = list[tuple[int, list[str]]]()
    for number, row in rows[1:] if names else rows:
        values = [row[column] if column < len(row) else "" for column in columns]
        if not all(map(_is_number, values)):
            raise RecordingError(
                f"{path}, line {number}: {','.join(row)[:60]!r} lacks a time or a rate; four"
                " numbers are expected, in rad/s"
            )
        chosen.append((number, values))
    if len(chosen) < 2:
        raise RecordingError(f"{path}: no samples of a gyroscope; time,x,y,z in rad/s are expected")
    times = parse_times(chosen, path, RecordingError)
    return [
        (t_ns, unit * np.array([float(value) for value in values[1:]]))
        for t_ns, (_, values) in zip(times, chosen, strict=True)
    ]


def _find_columns(names: Sequence[str], path: Path) -> tuple[list[int], float]:
    """Return the columns of time, x, y and z, and the unit of the rates in rad/s."""
    found = dict[str, int]()
    for column, name in enumerate(names):
        base = re.split(r"[\[(]", name)[0].strip(' "#_')
        axis = _AXIS.fullmatch(base)
        if "time" in base or base == "t":
            found.setdefault("t", column)
        elif axis is not None and _KINDS.fullmatch(axis["kind"]):
            found.setdefault(axis["axis"], column)
    if set(found) != set("txyz"):
        raise RecordingError(
            f"{path}, line 1: no columns of a gyroscope in {','.join(names)[:80]!r}; time,x,y,z"
            " in rad/s are expected"
        )
    unit = math.radians(1.0) if re.search(r"deg|°", names[found["x"]]) else 1.0
    return [found[name] for name in "txyz"], unit


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
