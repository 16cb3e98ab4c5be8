"""Match both side views of an image with the virtual views of the map around a pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features, Matches
from topoloc.features.virtual_views import VirtualView
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import (
    GuidedConfig,
    count_chance_matches,
    match_guided,
    select_visible_points,
)
from topoloc.localization.pose_fit import LocalMap
from topoloc.node_ids import NodeId, Row

_CELL_PX = 8


@dataclass(frozen=True, eq=False)
class QueryVirtualView:
    """Hold one side view of an image.

    `features` are at pixels of the view, `features_in_image` the same at pixels of the image.
    """

    view: VirtualView
    features: Features
    features_in_image: Features


@dataclass(frozen=True, eq=False)
class VirtualViewMatches:
    """Hold the features of both side views, at image pixels, matched with points around a pose."""

    features: Features
    local_map: LocalMap
    matches: Matches


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
    sides: list[tuple[QueryVirtualView, LocalMap]], cam_from_world: Rigid3, config: GuidedConfig
) -> VirtualViewMatches | None:
    """Return the guided matches of both sides, each with its own points. None if there are none."""
    guided = [
        match_guided(
            side.features, m, side.view.virtual_from_world(cam_from_world), side.view.camera, config
        )
        for side, m in sides
    ]
    return merge_matches(sides, guided)


def merge_matches(
    sides: list[tuple[QueryVirtualView, LocalMap]], matches: list[Matches]
) -> VirtualViewMatches | None:
    """Merge the matches of each side with its own points. None if there are none."""
    if sum(map(len, matches)) == 0:
        return None
    first_features = np.cumsum([0, *(len(side.features) for side, _ in sides)])
    first_points = np.cumsum([0, *(len(local_map.radii) for _, local_map in sides)])
    joined = Matches(
        np.concatenate(
            [one.query_idx + first for one, first in zip(matches, first_features, strict=False)]
        ).astype(np.int32),
        np.concatenate(
            [one.train_idx + first for one, first in zip(matches, first_points, strict=False)]
        ).astype(np.int32),
        np.concatenate([one.distances for one in matches]).astype(np.float32),
    )
    features = Features.concatenate([side.features_in_image for side, _ in sides])
    return VirtualViewMatches(
        features, LocalMap.concatenate([local_map for _, local_map in sides]), joined
    )


def count_virtual_views(
    sides: list[tuple[QueryVirtualView, LocalMap]], cam_from_world: Rigid3, config: GuidedConfig
) -> VirtualViewCounts:
    """Count the predicted and the agreeing points of both sides."""
    num_visible, num_by_chance, visible_img, agreeing_img = (
        0,
        0,
        [np.zeros((0, 2))],
        [np.zeros((0, 2))],
    )
    for side, local_map in sides:
        view, side_from_world = side.view, side.view.virtual_from_world(cam_from_world)
        rows, visible = select_visible_points(local_map, side_from_world, view.camera)
        columns, lines = np.clip(
            np.rint(visible).astype(int), 0, [view.camera.width - 1, view.camera.height - 1]
        ).T
        seen = np.flatnonzero(view.inside[lines, columns])
        cells = (lines[seen] // _CELL_PX) * view.camera.width + columns[seen] // _CELL_PX
        num_visible += len(np.unique(cells))
        num_by_chance += count_chance_matches(
            side.features, local_map, side_from_world, view.camera, config
        )
        seen = (
            seen[np.unique(np.linspace(0, len(seen) - 1, 512).astype(int))]  # bounds the time
            if len(seen)
            else seen
        )
        visible_img.append(view.points_img[lines[seen], columns[seen]].astype(np.float64))
        if (dense := side.features.dense) is not None and len(seen):
            agreeing_img.append(
                visible_img[-1][
                    dense.check_agreement(visible[seen], local_map.descriptors[rows[seen]])
                ]
            )
    has_dense = any(side.features.dense is not None for side, _ in sides)
    return VirtualViewCounts(
        num_visible,
        num_by_chance,
        np.concatenate(visible_img),
        np.concatenate(agreeing_img) if has_dense else None,
    )


def estimate_pose(
    found: VirtualViewMatches, camera: Camera, config: AbsolutePoseConfig, start: Rigid3 | None
) -> AbsolutePose | None:
    """Estimate cam_from_world of the image from the matches of both sides.

    The pose is refined from `start`, or estimated by RANSAC if it is None.
    """
    rows = found.matches.train_idx
    return estimate_absolute_pose(
        found.features.points_img[found.matches.query_idx].astype(np.float64),
        found.local_map.points_world[rows],
        camera,
        config,
        point_covariances=found.local_map.covariances[rows],
        start=start,
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


def with_node_id(local_map: LocalMap, node_id: NodeId) -> LocalMap:
    """Return the same points with the id of the node whose image shows them."""
    return replace(local_map, node_ids=np.full_like(local_map.node_ids, node_id))
