"""Define joins, the relative poses between tiles from images of one localized in another. Merge the
worlds that they connect, with a pose graph whose nodes are the worlds of tiles.

A join may be wrong, which is rare. One that contradicts joins with more agreeing images is dropped.
Joins never move a georeferenced world to another place on earth. One georeferenced tile
georeferences all tiles that are joined with it.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct, field
from msgspec.structs import replace

from topoloc.geometry.alignment import translation_error
from topoloc.geometry.geodesy import GeoPoint
from topoloc.geometry.rigid import Rigid3, inverse_covariance, skew
from topoloc.json_data import Count, Finite, encode_json
from topoloc.slam.pose_graph import PoseGraphEdge, compute_normalized_residuals, optimize_pose_graph

if TYPE_CHECKING:
    from topoloc.atlas.manifest import Tile

ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}\Z"
"""Pattern of tile ids and world names."""
TileId = Annotated[str, Meta(pattern=ID)]
_MAX_METRES = 1e8


class Join(Struct, frozen=True, eq=False):
    """Hold the relative pose of two tiles.

    `first_from_second` transforms the world of the second map into that of the first. `covariance`
    is that of its left perturbation (m, rad), from the localization results. `num_agreeing` is the
    number of images of either tile that agree. `residual` is the residual in sigmas after all joins
    are adjusted together. None: the join contradicts others and is not used.
    """

    first: TileId
    second: TileId
    first_from_second: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    num_agreeing: Count
    residual: Finite | None = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the join as a JSON object."""
        return encode_json(self)

    def sigmas_at(self, point_second: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Return one sigma of the position (m, in the worst direction) of a point of the second
        tile in the world of the first, and one sigma of the rotation (rad)."""
        return sigmas_at(self.first_from_second.apply(point_second), self.covariance)

    @property
    def pair(self) -> tuple[str, str]:
        """Return the ids of the two tiles."""
        return self.first, self.second


class JointPose(Struct, frozen=True, eq=False, rename={"joint": "world"}):
    """Hold the pose of a world in its joint world.

    The joint world has the name and coordinates of one of the joined worlds. `covariance` is that
    of the left perturbation of `joint_from_world` (m, rad).
    """

    joint: TileId
    joint_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))


def sigmas_at(
    point_a: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "6 6"]
) -> tuple[float, float]:
    """Return the position sigma (metres, worst direction) and rotation sigma (radians) of a
    transform.

    Args:
        point_a: the transformed point, in metres in frame a.
        covariance: covariance of the left perturbation of ``a_from_b`` (m, rad).
    """
    moved = np.hstack([np.eye(3), -skew(point_a)])
    metres, radians = (
        np.linalg.eigvalsh(block)[-1]
        for block in (moved @ covariance @ moved.T, covariance[3:, 3:])
    )
    return float(np.sqrt(max(metres, 0.0))), float(np.sqrt(max(radians, 0.0)))


def check_join(pose: Rigid3, covariance: Float[np.ndarray, "6 6"], is_definite: bool) -> None:
    """Check a relative pose and its covariance. Raises ValueError if the covariance is none, or the
    pose is further away than the earth is wide."""
    values = np.linalg.eigvalsh(covariance)
    slack = 1e-9 * max(float(values[-1]), 0.0)
    if (
        max(np.abs(pose.translation).max(), np.abs(covariance).max() ** 0.5) > _MAX_METRES
        or np.abs(covariance - covariance.T).max() > 2.0 * slack
        or values[0] < -slack
        or (is_definite and values[0] <= 0.0)
    ):
        raise ValueError("a join whose pose or covariance is none")


MAX_WORLD_OFFSET_M = 100.0
"""Maximum distance (metres) by which joins may displace a georeferenced world from its known
position."""


def place_tiles(
    tiles: Mapping[str, Tile], joins: Sequence[Join], origin: GeoPoint | None
) -> tuple[tuple[Tile, ...], tuple[Join, ...]]:
    """Return the tiles, sorted by id, with their poses in joint worlds and in the atlas world.

    All adjusted joins are returned as well. `origin` is the origin of the atlas world.
    """
    ordered = [_place_by_georeference(tiles[tile_id], origin) for tile_id in sorted(tiles)]
    known = {
        tile.world: tile.atlas_from_world
        for tile in reversed(ordered)
        if tile.atlas_from_world is not None
    }
    adjusted, joint_poses = adjust_joins(
        joins, {tile.tile_id: tile.world for tile in ordered}, known
    )
    placed: list[Tile] = []
    for tile in ordered:
        joint = joint_poses.get(tile.world)
        pose = tile.atlas_from_world or known.get(tile.world)
        if pose is None and joint is not None and joint.joint in known:
            pose = known[joint.joint] @ joint.joint_from_world
        box = tile.geo_box
        if box is None and pose is not None and origin is not None:
            corners = np.array(list(product(*tile.box_world.T)))
            in_ecef = (origin.ecef_from_enu() @ pose).apply(corners)
            box = geo_box([GeoPoint.from_ecef(corner) for corner in in_ecef])
        placed.append(replace(tile, joint=joint, atlas_from_world=pose, geo_box=box))
    return tuple(placed), adjusted


def _place_by_georeference(tile: Tile, origin: GeoPoint | None) -> Tile:
    """Return a tile with the pose in the atlas world that follows from its own georeference only.

    The atlas world is east-north-up at `origin`.
    """
    known = tile.georeference
    if known is None or origin is None:
        return replace(tile, atlas_from_world=None, geo_box=None)
    atlas_from_ecef = origin.ecef_from_enu().inverse()
    return replace(
        tile, atlas_from_world=atlas_from_ecef @ known.origin.ecef_from_enu() @ known.enu_from_world
    )


def geo_box(places: Sequence[GeoPoint]) -> tuple[float, float, float, float]:
    """Return the minimum latitude and longitude of places, then the maximum ones, in degrees."""
    lats, lons = [place.lat for place in places], [place.lon for place in places]
    return min(lats), min(lons), max(lats), max(lons)


def adjust_joins(
    joins: Sequence[Join], worlds: Mapping[str, str], atlas_from_worlds: Mapping[str, Rigid3]
) -> tuple[tuple[Join, ...], dict[str, JointPose]]:
    """Adjust all joins together and drop those that contradict others. Return the joins with their
    residuals, and the joint pose of each joined world, by name.

    Args:
        worlds: the world name of each tile, by tile id.
        atlas_from_worlds: poses of the georeferenced worlds. A joint world is named after one of
            these if it contains one.
    """
    max_residual = 8.0  # of a join that is kept, in standard deviations
    kept = sorted(joins, key=lambda join: (-join.num_agreeing, join.pair))
    dropped: list[Join] = []
    while True:
        far = _first_inconsistent_join(kept, worlds, atlas_from_worlds)
        if far is None:
            places = _optimize_worlds(kept, worlds, atlas_from_worlds)
            residuals = _residuals(kept, worlds, places)
            if not kept or max(residuals) <= max_residual:
                break
            far = kept[int(np.argmax(residuals))]
        kept.remove(far)
        dropped.append(replace(far, residual=None))
    used = [
        replace(join, residual=residual) for join, residual in zip(kept, residuals, strict=True)
    ]
    return tuple(sorted([*used, *dropped], key=lambda join: join.pair)), places


def _first_inconsistent_join(
    joins: Iterable[Join], worlds: Mapping[str, str], atlas_from_worlds: Mapping[str, Rigid3]
) -> Join | None:
    """Return the first join that contradicts a georeference, together with the joins before it.

    Only joins that connect two groups with georeferenced worlds are checked. Later joins have fewer
    agreeing images and do not change the paths between worlds.
    """
    groups: dict[str, set[str]] = {}
    taken: list[Join] = []
    for join in joins:
        taken.append(join)
        one, other = (groups.setdefault(worlds[end], {worlds[end]}) for end in join.pair)
        if one is other:
            continue
        both = one | other
        if not (
            one.isdisjoint(atlas_from_worlds) or other.isdisjoint(atlas_from_worlds)
        ) and _is_inconsistent(
            _groups(
                [known for known in taken if worlds[known.first] in both], worlds, atlas_from_worlds
            ),
            atlas_from_worlds,
        ):
            return join
        groups |= dict.fromkeys(both, both)
    return None


def _is_inconsistent(
    groups: Mapping[str, Mapping[str, JointPose]], atlas_from_worlds: Mapping[str, Rigid3]
) -> bool:
    """Return whether joins place a world elsewhere than its georeference does."""
    placed = (
        (atlas_from_worlds[anchor] @ group[name].joint_from_world, atlas_from_worlds[name])
        for anchor, group in groups.items()
        for name in group.keys() & atlas_from_worlds.keys()
    )
    return any(translation_error(*pair) > MAX_WORLD_OFFSET_M for pair in placed)


_WorldLink = tuple[int, str, Rigid3, Float[np.ndarray, "6 6"]]
"""A link from one world to another: the number of agreeing images, the other world, and the
transform from it with its covariance."""


def _groups(
    joins: Sequence[Join], worlds: Mapping[str, str], anchored: Mapping[str, Rigid3]
) -> dict[str, dict[str, JointPose]]:
    """Return the groups of joined worlds, by the name of the world that gives the coordinates.

    The pose of each world follows the path with the most agreeing images.
    """
    links: dict[str, list[_WorldLink]] = {}
    for join in joins:
        one, other, pose = worlds[join.first], worlds[join.second], join.first_from_second
        back = pose.inverse(), inverse_covariance(pose, join.covariance)
        links.setdefault(one, []).append((join.num_agreeing, other, pose, join.covariance))
        links.setdefault(other, []).append((join.num_agreeing, one, *back))
    groups, seen = dict[str, dict[str, JointPose]](), set[str]()
    for anchor in sorted(links, key=lambda name: (name not in anchored, name)):
        if anchor not in seen:
            groups[anchor] = _reachable_worlds(anchor, links)
            seen |= groups[anchor].keys()
    return groups


def _reachable_worlds(
    anchor: str, links: Mapping[str, Sequence[_WorldLink]]
) -> dict[str, JointPose]:
    """Return the pose of every world that joins connect to the anchor.

    The next join is always the one with the most agreeing images from the worlds reached so far.
    """
    places = dict[str, JointPose]()
    queue, count = [(0, 0, anchor, JointPose(anchor, Rigid3.identity()))], 0
    while queue:
        _, _, name, place = heapq.heappop(queue)
        if name in places:
            continue
        places[name] = place
        for num_agreeing, to, pose, of_link in links[name]:
            if to not in places:
                moved = place.joint_from_world.transform_covariance(of_link)
                reached = JointPose(anchor, place.joint_from_world @ pose, place.covariance + moved)
                count += 1
                heapq.heappush(queue, (-num_agreeing, count, to, reached))
    return places


def _optimize_worlds(
    joins: Sequence[Join], worlds: Mapping[str, str], anchored: Mapping[str, Rigid3]
) -> dict[str, JointPose]:
    """Return the pose of each world after the adjustment of all joins.

    The covariance is that of a single path, which is an upper bound.
    """
    places = dict[str, JointPose]()
    for anchor, group in _groups(joins, worlds, anchored).items():
        names = [anchor, *(name for name in group if name != anchor)]
        rows = {name: row for row, name in enumerate(names)}
        edges = [_edge(join, worlds, rows) for join in joins if worlds[join.first] in rows]
        poses = [group[name].joint_from_world.inverse() for name in names]
        poses = optimize_pose_graph(poses, edges) if len(edges) >= len(names) else poses
        for name, world_from_joint in zip(names, poses, strict=True):
            places[name] = replace(group[name], joint_from_world=world_from_joint.inverse())
    return places


def _edge(join: Join, worlds: Mapping[str, str], rows: Mapping[str, int]) -> PoseGraphEdge:
    return PoseGraphEdge(
        rows[worlds[join.second]],
        rows[worlds[join.first]],
        join.first_from_second,
        join.covariance,
        is_loop=True,
    )


def _residuals(
    joins: Sequence[Join], worlds: Mapping[str, str], places: Mapping[str, JointPose]
) -> list[float]:
    rows = {name: row for row, name in enumerate(places)}
    poses = [place.joint_from_world.inverse() for place in places.values()]
    edges = [_edge(join, worlds, rows) for join in joins]
    return compute_normalized_residuals(poses, edges).tolist()
