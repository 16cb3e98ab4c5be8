"""Localizing a single image in an atlas: which tiles, in which order, until when.

The picture's features are extracted once, whatever number of tiles asks for them. The index ranks
the tiles (`index.py`) by the cheapest kind of features. A tile that leads by far is asked at once
by all means (`localization/localizer.py`); else the likeliest are asked at a glance, by retrieval
alone, until a pose is clear. Where none is, the next kind of features ranks them, and more are
asked at a glance; the most promising ones by all means until one answers. Last, tiles that look as
much like the picture as the one that answered must not vouch for a pose as well (`verdict.py`):
aliasing grows with the number of places. They are asked as look-alikes within a map are: one that
agrees with far fewer of the picture's strongest features is left at that.
"""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Literal

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.hearing import Hearing, Ranking
from topoloc.atlas.near import Near, tiles_in_reach
from topoloc.atlas.open_maps import Maps, OpenedMap
from topoloc.atlas.verdict import Heard, joint_result, of_tile
from topoloc.bounds import check_bounds
from topoloc.errors import AtlasError, MapError, MissingExtraError, StoreError, WeightsError
from topoloc.features.kinds import KINDS, FeatureConfig, check_available
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.localizer import LocalizerConfig
from topoloc.localization.query import Picture, Query, StageClock, reduced_image, unknown_camera
from topoloc.localization.result import Alternative, Localization, NotLocalized, at_time
from topoloc.retrieval.coarse import Image
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

Way = Literal["by all means", "at a glance", "as a rival"]
"""How a tile is asked; as a rival of an answer, at a glance, and only where it may be one."""


class AtlasLocalizer:
    """Answers from an atlas as it was when it was opened.

    `problems` says of tiles that could not be asked why, by their ids; whoever is asked for them
    goes on without.

    Args:
        maps: opens the tiles and keeps those used last.
        warn: told once of each tile that cannot be asked.

    Raises:
        ConfigError: a setting is out of bounds.
        AtlasError: the atlas has no tile.
    """

    def __init__(
        self,
        atlas: Atlas,
        maps: Maps,
        config: AtlasConfig | None = None,
        warn: Callable[[str], None] = warnings.warn,
    ) -> None:
        self.atlas, self.config, self._maps, self._warn = atlas, config or AtlasConfig(), maps, warn
        check_bounds(self.config)
        if not atlas.manifest.tiles:
            raise AtlasError(
                f"the atlas {atlas.store.where} has no tiles; `topoloc atlas add` adds them"
            )
        self.problems: dict[str, str] = {}
        for note in atlas.notes:
            self._warn(note)
        for tile_id, problem in atlas.problems.items():
            self._warn(f"tile {tile_id} is asked after all others: {problem}")
        self._reached: Mapping[str, Rigid3 | None] | None = None
        self._nowhere = ""
        self._focal = max(tile.focal_px for tile in atlas.manifest.tiles)

    def near(self, near: Near | None, placed_only: bool = False) -> AtlasLocalizer:
        """One that asks only tiles in reach of where somebody knows the camera to be (`near.py`); a
        pose that is given is tried, too.

        Args:
            placed_only: only tiles that know where on earth they lie.

        Raises:
            AtlasError: no tile is of the world that is named.
        """
        other = copy.copy(self)
        other._reached = tiles_in_reach(self.atlas.manifest, near, placed_only)
        other._nowhere = (
            f"no tile lies {near}" if near is not None else "no tile knows where on earth it lies"
        )
        return other

    def localize(
        self,
        image: Image,
        camera: Camera | RoughCamera | None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
        t_ns: int | None = None,
        tile_id: str | None = None,
    ) -> Localization | NotLocalized:
        """Where was this image (grey or RGB, uint8) taken, and in which tile? As
        `Localizer.localize`; the result's provenance names the tile, in whose world its pose is.

        Args:
            prior: about where the camera is, in the world of the tile `tile_id`, which is then
                asked alone.
            max_ms: after so many milliseconds no further tile or hypothesis is sought, instead of
                `config.max_ms`.
            tile_id: only this tile is asked.

        Raises:
            QueryError: the image is no picture of 8 bits, or the camera is of another image size.
            AtlasError: there is no such tile, a prior comes without one, or no tile can be read.
            StoreError: the object store does not answer that holds a tile which must be asked.
        """
        start, limit = time.perf_counter(), max_ms if max_ms is not None else self.config.max_ms
        deadline = float("inf") if limit is None else start + limit / 1e3
        picture = Picture(image, camera or unknown_camera(image))
        if prior is not None and tile_id is None:
            raise AtlasError("a prior is a pose in one tile's world: name the tile")
        if tile_id is None and self._reached is not None and not self._reached:
            return self.completed(NotLocalized("not_in_map", detail=self._nowhere), t_ns)
        hearing, clock = Hearing(picture, deadline), StageClock()
        if tile_id is None:
            self._hear(hearing, clock)
        else:
            self._ask(hearing, self.atlas.tile(tile_id).tile_id, 1.0, prior=prior)
        if not hearing.heard:
            raise AtlasError(
                f"no tile of the atlas {self.atlas.store.where} can be asked:"
                f" {next(iter(self.problems.values()), 'no time')}"
            )
        result = self._on_earth(joint_result(list(hearing.heard.values())))
        result = replace(
            result,
            times_ms=_all_times(hearing, clock) | {"total": 1e3 * (time.perf_counter() - start)},
        )
        return result if t_ns is None else at_time(result, t_ns)

    def lend(self, tile_id: str) -> OpenedMap:
        """The map of a tile, which stays open until it is given back. Raises AtlasError,
        MapError."""
        return self._maps.lend(tile_id, self._maps.tile_path(self.atlas, self.atlas.tile(tile_id)))

    def give_back(self, opened: OpenedMap) -> None:
        """The map that was lent may be closed."""
        self._maps.give_back(opened)

    def named(
        self, result: Localization | NotLocalized, tile_id: str
    ) -> Localization | NotLocalized:
        """What a tile's own map says, as the atlas says it: with the tile's name and its place in
        the atlas, where that is known."""
        return self._on_earth(of_tile(result, self.atlas.tile(tile_id)))

    def _on_earth(self, result: Localization | NotLocalized) -> Localization | NotLocalized:
        """With the geoposes of tiles that know through others where on earth they lie."""
        manifest, tile_id = self.atlas.manifest, result.provenance.tile
        if isinstance(result, NotLocalized):
            alternatives = [self._alternative_on_earth(one) for one in result.alternatives]
            return replace(result, alternatives=tuple(alternatives)) if alternatives else result
        place = (
            manifest.georeference_of(manifest.by_id[tile_id])
            if tile_id is not None and result.geopose is None
            else None
        )
        return (
            result
            if place is None
            else replace(result, geopose=place.geopose(result.world_from_cam))
        )

    def _alternative_on_earth(self, one: Alternative) -> Alternative:
        manifest = self.atlas.manifest
        place = (
            manifest.georeference_of(manifest.by_id[one.tile])
            if one.tile is not None and one.geopose is None
            else None
        )
        return one if place is None else replace(one, geopose=place.geopose(one.world_from_cam))

    def completed(self, result: NotLocalized, t_ns: int | None = None) -> NotLocalized:
        """What is said of a picture that could not be asked, with its time (nanoseconds)."""
        return result if t_ns is None else at_time(result, t_ns)

    def rank(self, picture: Picture) -> Ranking:
        """The tiles that look most like the picture; behind them those whose places cannot be
        ranked."""
        *_, ranking = self._rankings(picture, StageClock())
        return ranking

    def _rankings(self, picture: Picture, clock: StageClock) -> Iterator[Ranking]:
        """As `rank`, by the cheapest kind of features; then by the next as well, until a tile
        leads."""
        sizes = (
            LocalizerConfig()
        )  # those that tiles reduce a picture by, so that they find its features extracted
        image, lens = reduced_image(
            picture.image, picture.camera, self._focal, sizes.max_finer, sizes.max_side_px
        )
        unranked = [
            (tile_id, 0.0)
            for tile_id in self.atlas.problems
            if self._reached is None or tile_id in self._reached
        ]
        vectors, ranking = {}, Ranking()
        for kind in self._ranked_by:
            vocabulary = shared_vocabulary(kind)
            assert vocabulary is not None
            features = Query(
                image, lens, 1.0, FeatureConfig(kind=kind), clock, shared=picture.features
            ).features
            with clock.stage("tiles"):
                vectors[kind] = vocabulary.vector(features, lens.width, lens.height)
                ranking = self.atlas.index.rank(vectors, self.config.num_ranked, self._reached)
            yield ranking + unranked
            if _gap(ranking) >= self.config.settled_gap:
                return
        if not vectors:
            yield unranked

    @cached_property
    def _ranked_by(self) -> list[str]:
        """The kinds of features that tiles can be ranked by and that can be had here, the cheapest
        first."""
        return [kind for kind in KINDS if kind in self.atlas.index.kinds and _is_available(kind)]

    def _hear(self, hearing: Hearing, clock: StageClock) -> None:
        """Ask tiles until one answers; then those that look as much like the picture."""
        for number, ranking in enumerate(self._rankings(hearing.picture, clock), start=1):
            hearing.ranking = ranking
            if _gap(self._left(ranking)) < self.config.settled_gap:
                self._glance(
                    hearing,
                    (
                        self.config.num_glanced
                        if number >= len(self._ranked_by)
                        else self.config.num_glanced_first
                    ),
                )
            if hearing.is_settled or hearing.is_late:
                break
        hopeful = self._hopeful(hearing)
        for number in range(self.config.num_asked):
            left = [one for one in self._left(hopeful) if not hearing.was_asked(one[0])]
            if number:
                left = [one for one in left if self._is_promising(hearing, one)]
            if not left or hearing.answers or (hearing.heard and hearing.is_late):
                break
            self._ask(hearing, *max(left, key=hearing.promise))
        while not hearing.heard and (
            left := self._left(hearing.ranking)
        ):  # those that were likely cannot be read
            self._ask(hearing, *left[0])
        self._hear_look_alikes(hearing)

    def _hopeful(self, hearing: Hearing) -> Ranking:
        """Tiles that look not far less like the picture than the best one."""
        ranking = self._left(hearing.ranking)
        return [
            one
            for one in ranking
            if one[1] >= ranking[0][1] - self.config.hopeless_gap or one[0] in self.atlas.problems
        ]

    def _is_promising(self, hearing: Hearing, ranked: tuple[str, float]) -> bool:
        """Does a glance name a pose there, or does it look more like the picture than any place
        does? One that is not ranked may."""
        return (
            hearing.promise(ranked) >= (0.0, self.config.least_likeness)
            or ranked[0] in self.atlas.problems
        )

    def _glance(self, hearing: Hearing, num_tiles: int) -> None:
        """Ask the likeliest tiles at a glance, until a pose is clear."""
        for tile_id, likeness in self._hopeful(hearing)[:num_tiles]:
            if hearing.is_settled or hearing.is_late:
                return
            if tile_id not in hearing.heard:
                self._ask(hearing, tile_id, likeness, "at a glance")

    def _left(self, ranking: Ranking) -> Ranking:
        """Without tiles that cannot be read."""
        return [one for one in ranking if one[0] not in self.problems]

    def _hear_look_alikes(self, hearing: Hearing) -> None:
        """Tiles that look about as much like the picture as the one that answered, at a glance,
        where the cheapest test leaves open that they rival it."""
        if not hearing.answers:
            return
        least = min(answer.likeness for answer in hearing.answers) - self.config.alike_gap
        alike = [
            (tile_id, likeness)
            for tile_id, likeness in hearing.ranking
            if likeness >= least and tile_id not in hearing.heard
        ]
        for tile_id, likeness in alike[: self.config.num_alike]:
            if not hearing.is_late:
                self._ask(hearing, tile_id, likeness, "as a rival")
        for one in [
            one for one in hearing.heard.values() if one.is_clear and not one.is_full
        ]:  # it may be the answer itself
            self._ask(hearing, one.tile.tile_id, one.likeness)

    def _ask(
        self,
        hearing: Hearing,
        tile_id: str,
        likeness: float,
        way: Way = "by all means",
        prior: Rigid3 | None = None,
    ) -> None:
        """Put the picture to a tile; where that cannot be read, the others answer."""
        if tile_id in self.problems:
            hearing.heard.pop(tile_id, None)
            return
        tile = self.atlas.tile(tile_id)
        try:
            with self._maps.lent(tile_id, self._maps.tile_path(self.atlas, tile)) as opened:
                known = (
                    prior
                    if prior is not None or self._reached is None
                    else self._reached.get(tile_id)
                )
                before, asking = hearing.begun.get(tile_id, (None, None))
                if asking is None or before is not opened:
                    asking = opened.localizer.asking(hearing.picture, known, hearing.left_ms)
                hearing.begun[tile_id] = opened, asking
                if way == "as a rival" and not hearing.may_be_rival(asking):
                    return
                result, named = (
                    asking.by_all_means() if way == "by all means" else asking.at_a_glance()
                )
        except StoreError:  # what the tile would have said nobody knows
            raise
        except MapError as error:
            self.problems[tile_id] = str(error)
            hearing.heard.pop(tile_id, None)
            self._warn(f"tile {tile_id} is not asked: {error}")
            return
        hearing.heard[tile_id] = Heard(
            tile, result, tuple(one for one, _ in named), way == "by all means", likeness
        )


def _gap(ranking: Ranking) -> float:
    """By how much the likeliest tile leads the next one; infinite of one tile alone."""
    return ranking[0][1] - ranking[1][1] if len(ranking) > 1 else float("inf")


def _is_available(kind: str) -> bool:
    try:
        check_available(kind)
    except (MissingExtraError, WeightsError):
        return False
    return True


def _all_times(hearing: Hearing, clock: StageClock) -> dict[str, float]:
    """Milliseconds of each stage, of all tiles together; `tiles` is that of ranking them, without
    the features."""
    total = clock.times_ms()
    for _, asking in hearing.begun.values():
        for stage, ms in asking.times_ms.items():
            total[stage] = total.get(stage, 0.0) + ms
    return total
