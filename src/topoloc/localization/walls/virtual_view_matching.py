"""Match both side views of an image with the virtual views of the map around a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain

import numpy as np
from jaxtyping import Float, UInt8

from topoloc.features.extraction import (
    VirtualView,
    extract_from_normalized,
    make_virtual_views,
    normalize_image,
)
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features, Matches
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.evidence import sample_rows
from topoloc.localization.guided import (
    GuidedConfig,
    count_chance_matches,
    match_guided,
    select_visible_points,
)
from topoloc.localization.pose_fit import LocalMap, PointMatches
from topoloc.localization.search import Search
from topoloc.localization.walls.virtual_view_index import (
    CandidatePlaces,
    VirtualViewIndex,
    select_likeliest_places,
)
from topoloc.node_ids import Row

_CELL_PX = 8


@dataclass(frozen=True, eq=False)
class QueryVirtualView:
    """Hold one side view of an image.

    `features` are at pixels of the view, `features_in_image` the same at pixels of the image.
    `tangents` are those of the image's `camera`.
    """

    view: VirtualView
    features: Features
    features_in_image: Features
    camera: Camera

    @staticmethod
    def from_features(view: VirtualView, features: Features, camera: Camera) -> QueryVirtualView:
        """Return a view of an image that `camera` took."""
        return QueryVirtualView(view, features, view.to_image_pixels(features, camera), camera)

    @cached_property
    def tangents(self) -> Float[np.ndarray, "n 2"]:
        """Return the tangents (x / z, y / z) of the features in the image's camera."""
        return self.camera.normalized_from_img(self.features_in_image.points_img.astype(np.float64))


Sides = list[tuple[QueryVirtualView, LocalMap]]
"""Side views of an image, each with the points around a pose."""


@dataclass(frozen=True, eq=False)
class VirtualViewCounts:
    """Hold the predicted content of the side views at a pose and the chance matches.

    `num_visible` counts cells of 8 pixels with a predicted point, because neighbouring virtual
    views hold the same wall. `num_by_chance` is the number of matches that a wrong pose would give.
    `visible_img` holds image pixels of predicted points, at most 512 of each side. `agreeing_img`
    holds the pixels at which dense descriptors agree. It is None for feature types without them.
    """

    num_visible: int
    num_by_chance: int
    visible_img: Float[np.ndarray, "v 2"]
    agreeing_img: Float[np.ndarray, "a 2"] | None


def match_virtual_views(
    sides: Sides, cam_from_world: Rigid3, camera: Camera, config: GuidedConfig
) -> PointMatches | None:
    """Return the guided matches of both sides, each with its own points. None if there are none."""
    guided = [
        match_guided(
            side.features, m, side.view.virtual_from_world(cam_from_world), side.view.camera, config
        )
        for side, m in sides
    ]
    return merge_matches(sides, guided, camera)


def merge_matches(sides: Sides, matches: list[Matches], camera: Camera) -> PointMatches | None:
    """Merge the matches of each side with its own points, at pixels of the image of `camera`.

    None if there are none.
    """
    if sum(map(len, matches)) == 0:
        return None
    first_features = np.cumsum([0, *(len(side.features) for side, _ in sides)])
    first_points = np.cumsum([0, *(len(local_map.radii) for _, local_map in sides)])
    rows = [one.query_idx + first for one, first in zip(matches, first_features, strict=False)]
    columns = [one.train_idx + first for one, first in zip(matches, first_points, strict=False)]
    joined = Matches(
        np.concatenate(rows).astype(np.int32),
        np.concatenate(columns).astype(np.int32),
        np.concatenate([one.distances for one in matches]).astype(np.float32),
    )
    features = Features.concatenate([side.features_in_image for side, _ in sides])
    local_map = LocalMap.concatenate([local_map for _, local_map in sides])
    return PointMatches(features, camera, camera, local_map, joined)


def count_virtual_views(
    sides: Sides, cam_from_world: Rigid3, config: GuidedConfig
) -> VirtualViewCounts:
    """Count the predicted and the agreeing points of both sides."""
    num_visible, num_by_chance = 0, 0
    visible_img, agreeing_img = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for side, local_map in sides:
        view, side_from_world = side.view, side.view.virtual_from_world(cam_from_world)
        rows, visible = select_visible_points(local_map.points_world, side_from_world, view.camera)
        last = [view.camera.width - 1, view.camera.height - 1]
        columns, lines = np.clip(np.rint(visible).astype(int), 0, last).T
        seen = np.flatnonzero(view.inside[lines, columns])
        cells = (lines[seen] // _CELL_PX) * view.camera.width + columns[seen] // _CELL_PX
        num_visible += len(np.unique(cells))
        num_by_chance += count_chance_matches(
            side.features, local_map, side_from_world, view.camera, config
        )
        if len(seen):
            seen = seen[sample_rows(len(seen))]
        visible_img.append(view.points_img[lines[seen], columns[seen]].astype(np.float64))
        if (dense := side.features.dense) is not None and len(seen):
            is_alike = dense.check_agreement(visible[seen], local_map.descriptors[rows[seen]])
            agreeing_img.append(visible_img[-1][is_alike])
    has_dense = any(side.features.dense is not None for side, _ in sides)
    return VirtualViewCounts(
        num_visible,
        num_by_chance,
        np.concatenate(visible_img),
        np.concatenate(agreeing_img) if has_dense else None,
    )


def select_nearest_virtual_nodes(
    view: VirtualView,
    cam_from_world: Rigid3,
    centres: Float[np.ndarray, "nodes 3"],
    axes: Float[np.ndarray, "nodes 3"],
    num_nodes: int,
) -> list[Row]:
    """Select virtual views with a similar direction whose content lies in the view, central first.

    The position of a virtual view is not compared. It shows points well ahead of it, and a camera
    in the reverse direction sees them from beyond.

    Args:
        centres: the middles (metres, world) of the virtual views' content.
        axes: their viewing directions (world).
    """
    side_from_world = view.virtual_from_world(cam_from_world)
    looks_alike = side_from_world.rotation[2] @ axes.T > 0.7
    size = np.array([view.camera.width, view.camera.height])
    off_middle = np.linalg.norm(
        (view.camera.img_from_cam(side_from_world.apply(centres)) - size / 2.0) / size[0], axis=1
    )
    off_middle = np.where(looks_alike & np.isfinite(off_middle), off_middle, np.inf)
    return [
        Row(int(k))
        for k in np.argsort(off_middle, kind="stable")[:num_nodes]
        if off_middle[k] < 1.0
    ]


@dataclass(frozen=True, eq=False)
class VirtualViewSearch:
    """Hold both side views of a query image and the candidate places (world_from_cam), likeliest
    first."""

    search: Search
    index: VirtualViewIndex
    seen: list[QueryVirtualView]
    places: list[Rigid3]

    @staticmethod
    def around(
        search: Search, index: VirtualViewIndex, max_tangent: float = math.inf
    ) -> VirtualViewSearch:
        """Extract both side views of the query image and select the candidate places.

        Walls beyond `max_tangent` ahead, a tangent off the view's axis, are left out.
        """
        num_d_thresh = 2.0  # minimum distance between these places, in D_thresh
        query, seen, named = search.query, list[QueryVirtualView](), list[CandidatePlaces]()
        assert isinstance(query.input_camera, Camera)
        for view in make_virtual_views(query.input_camera):
            picture = view.picture(query.grey)
            extract = partial(
                _extract_view_features, index.feature_config, view, picture, max_tangent
            )
            seen_by = (view.name, index.feature_config, max_tangent)
            features = query.shared.get_or_extract(query, seen_by, extract)
            seen.append(QueryVirtualView.from_features(view, features, query.input_camera))
            named.append(
                CandidatePlaces.from_similarity(view, index, index.similarity(picture, features))
            )
        apart = num_d_thresh * search.map.d_thresh
        return VirtualViewSearch(
            search,
            index,
            seen,
            select_likeliest_places(named, search.config.walls.num_places, apart),
        )

    @property
    def camera(self) -> Camera:
        """Return the camera of the query."""
        return self.search.query.camera

    def rows_around(self, side: QueryVirtualView, cam_from_world: Rigid3) -> list[Row]:
        """Return the virtual views of the map that show the content of a side view at a pose."""
        # Number of virtual views around a pose whose points are searched in each side
        # view.
        num_nodes = 4
        return select_nearest_virtual_nodes(
            side.view, cam_from_world, self.index.centres, self.index.axes, num_nodes
        )

    def sides_around(self, cam_from_world: Rigid3) -> Sides:
        """Return each side view with the points predicted in it."""
        rows = [(side, self.rows_around(side, cam_from_world)) for side in self.seen]
        return [(side, self._pool(of)) for side, of in rows if of and len(side.features)]

    def match(self, cam_from_world: Rigid3, radius_px: float) -> PointMatches | None:
        """Return the guided matches of both views around a pose. None if there are none."""
        sides, config = self.sides_around(cam_from_world), self.guided(radius_px)
        return match_virtual_views(sides, cam_from_world, self.camera, config)

    def guided(self, radius_px: float) -> GuidedConfig:
        """Return the settings of guided matching with this radius."""
        return replace(self.search.config.walls.guided, radius_px=radius_px)

    @cached_property
    def local_map_of_places(self) -> LocalMap:
        """Return the points visible from any of the candidate places."""
        rows = (
            self.rows_around(side, place.inverse()) for place in self.places for side in self.seen
        )
        return self._pool(sorted(set(chain.from_iterable(rows))))

    def _pool(self, rows: list[Row]) -> LocalMap:
        return LocalMap.concatenate(self.index.local_map.pool(rows))


def _extract_view_features(
    config: FeatureConfig, view: VirtualView, picture: UInt8[np.ndarray, "a b"], max_tangent: float
) -> Features:
    """Extract the features of a view. Those of a part of it have no dense descriptors."""
    if math.isinf(max_tangent):
        return view.select_inside(extract_from_normalized(normalize_image(picture, config), config))
    columns = view.columns_within(max_tangent)
    part = np.ascontiguousarray(picture[:, columns])
    features = extract_from_normalized(normalize_image(part, config), config)
    moved = features.points_img + np.array([columns.start, 0], np.float32)
    return view.select_inside(replace(features, points_img=moved, dense=None))
