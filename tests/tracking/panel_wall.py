"""Simulate the localizer of a wall of equal panels, one metre apart, without images or a map. Tests
set its results."""

from __future__ import annotations

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import LocalizationWithInliers
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_context import MapContext
from topoloc.localization.pose_fit import PointObservations
from topoloc.localization.query import Deadline, QueryImage
from topoloc.localization.result import Alternative, Localization, NotLocalized
from topoloc.localization.search import Trace
from topoloc.localization.tiles.tiles import Tiles
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker

CAMERA = Camera.pinhole(96, 72, 80.0, 80.0, 48.0, 36.0)
INTERVAL_NS = 375_000_000
STEP = 0.45
"""Metres from image to image."""
_SIGMA = np.diag(np.full(6, 1e-6))


def at(x: float) -> Rigid3:
    return Rigid3(np.eye(3), np.array([x, 0.0, 0.0]))


class PanelWall(Localizer):
    """Localize each image at one of `xs`, the likeliest first. A search near a pose returns the one
    within half a panel. `probability` is used if there is only one."""

    def __init__(self) -> None:
        self.xs: list[float] = []
        self.num_asked, self.probability = 0, 0.99
        self.config = LocalizerConfig()
        opened = MapContext(TopoMetricMap([], {}, [], []), self.config, (), {})
        self._tiles = Tiles(opened)

    def localize_query(
        self,
        query_image: QueryImage,
        prior: Rigid3 | None = None,
        max_ms: float | Deadline | None = None,
        trace: Trace | None = None,
        tile_id: str | None = None,
    ) -> tuple[Localization | NotLocalized, list[LocalizationWithInliers]]:
        self.num_asked += 1
        xs = self.xs
        if prior is not None:
            xs = sorted(
                (x for x in xs if abs(x - prior.translation[0]) < 0.5),
                key=lambda x: abs(x - prior.translation[0]),
            )[:1]
        if not xs:
            return NotLocalized("not_in_map"), []
        if len(xs) == 1:
            named = _answered(xs[0], self.probability)
            return named[0], [named]
        shares = [0.9 * (len(xs) - number) / sum(range(len(xs) + 1)) for number in range(len(xs))]
        alternatives = tuple(Alternative(at(x), p, int(x)) for x, p in zip(xs, shares, strict=True))
        return NotLocalized("ambiguous", alternatives=alternatives), [
            _answered(x, p) for x, p in zip(xs, shares, strict=True)
        ]


def _answered(x: float, probability: float) -> LocalizationWithInliers:
    """Return a result with too few points for tracking."""
    return Localization(at(x), _SIGMA, probability, int(x), [], 40, 40), _points(x)


def _points(x: float) -> PointObservations:
    points_cam = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5], [0.0, 0.1, 0.5], [0.1, 0.1, 0.5]])
    covariances = np.tile(1e-6 * np.eye(3), (4, 1, 1))
    return PointObservations(
        CAMERA.img_from_cam(points_cam).astype(np.float32),
        points_cam + np.array([x, 0.0, 0.0]),
        covariances,
    )


class Walk:
    """Simulate a camera that moves along the wall, at x = 0.45 k in image k. Its odometry drifts
    by one per cent."""

    def __init__(self, has_odometry: bool = True) -> None:
        self.wall, self._has_odometry, self._number = PanelWall(), has_odometry, 0
        self.tracker = Tracker(self.wall)
        self._rng = np.random.default_rng(0)

    @property
    def x(self) -> float:
        """Return the place of the last image."""
        return STEP * (self._number - 1)

    def see(self, *offsets: float) -> StreamedPose:
        """Process the next image. Its result may have these offsets from the truth, the
        likeliest first."""
        number, self._number = self._number, self._number + 1
        self.wall.xs = [STEP * number + offset for offset in offsets]
        image = self._rng.integers(0, 255, (CAMERA.height, CAMERA.width), dtype=np.uint8)
        odom_from_cam = at(1.01 * STEP * number) if self._has_odometry else None
        return self.tracker.process(image, CAMERA, number * INTERVAL_NS, odom_from_cam)
