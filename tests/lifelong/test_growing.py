"""Test a map that grows by pieces: an unknown stretch joins when the camera returns
to known places."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from built_corridor import WIDE, ahead, corridor
from tiny_world import BASELINE, render, right_pose
from topoloc.errors import MapError
from topoloc.geometry.rig import StereoRig
from topoloc.lifelong.growing import GrowingMap
from topoloc.mapping.config import MapConfig
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import IndexedFrames, StereoFrame

FIRST, DARK = [-3.0 + 0.1 * k for k in range(20)], 20
FAR = [7.5 - 0.135 * k for k in range(78)]
"""After the dark, the camera is at the other end and moves backwards to its start."""


@dataclass(eq=False, repr=False)
class Interrupted(IndexedFrames):
    """Hold stereo pairs along the corridor. A pair at None is dark."""

    ys: list[float | None]
    name: str = "walk"

    def __post_init__(self) -> None:
        self.names = [f"{number:03d}" for number in range(len(self.ys))]
        self.t_ns = [number * 100_000_000 for number in range(len(self.ys))]
        self.poses = [None] * len(self.ys)
        self._frames: dict[int, StereoFrame] = {}  # each is read several times

    def __len__(self) -> int:
        return len(self.ys)

    def read_frame(self, row: int) -> StereoFrame:
        if row not in self._frames:
            self._frames[row] = self._render(row)
        return self._frames[row]

    def _render(self, row: int) -> StereoFrame:
        y, shape = self.ys[row], (WIDE.height, WIDE.width)
        if y is None:
            left = right = np.zeros(shape, np.uint8)
        else:
            left, right = (
                render(corridor(), pose, WIDE, noise_seed=2 * row + side)[0]
                for side, pose in enumerate((ahead(y), right_pose(ahead(y))))
            )
        rig = StereoRig.rectified(WIDE, BASELINE)
        return StereoFrame(self.names[row], self.t_ns[row], left, WIDE, right, rig)


def errors_m(topomap: TopoMetricMap, ys: list[float | None]) -> dict[float, float]:
    """Return the position error in metres of each node, by its place in the corridor."""
    first, off = ahead(FIRST[0]), {}
    for one in topomap.summaries:
        y = ys[int(one.name)]
        assert y is not None
        apart = first @ one.world_from_cam
        off[y] = float(np.linalg.norm(apart.translation - ahead(y).translation))
    return off


@pytest.mark.slow
def test_unknown_stretch_joins_when_the_camera_is_back(tmp_path: Path):
    ys = [*FIRST, *[None] * DARK, *FAR]
    walk = Interrupted(ys)
    growing = GrowingMap(tmp_path / "walk.topo", MapConfig(other_kinds=()))
    growths = [growing.add(walk, stop) for stop in (20, 40, 66, 92, 118)]
    assert growths[0].num_posed == 20
    assert growths[1].num_posed == 0
    assert growths[2].num_apart > 0  # the far end is unknown
    assert growths[-1].num_apart == 0
    topomap = growing.finish()
    assert topomap is not None
    off = errors_m(topomap, ys)
    assert max(off) > 6.5  # the far end is in the map
    assert max(off.values()) < 0.15
    growing.close()


def test_existing_map_is_not_replaced(room_map: Path):
    with pytest.raises(MapError, match="it exists"):
        GrowingMap(room_map)


def test_counts_of_one_session_add_up():
    none = np.zeros((2, 3, 3))
    measured = LandmarkStatistics.from_equations(
        3, np.array([1, 4]), none + 9.0 * np.eye(3), np.ones((2, 3)), *np.array([[2, 2], [1, 2]])
    )
    expected, seen = np.array([0, 5, 5]), np.array([0, 4, 0])
    total = measured.with_counts(LandmarkStatistics.of_counts(3, expected, seen))
    assert total.rows.tolist() == [1, 2, 4]
    assert total.expected.tolist() == [7, 5, 2]
    assert total.seen.tolist() == [5, 0, 2]
    assert np.array_equal(total.roots[[0, 2]], measured.roots)
    assert np.array_equal(total.pulls[[0, 2]], measured.pulls)
    only_counted = LandmarkStatistics(
        3,
        total.rows[1:2],
        total.roots[1:2],
        total.pulls[1:2],
        *[total.expected[1:2], total.seen[1:2]],
    )
    assert only_counted.is_count_only
