"""Localizing a single image in an atlas: which tiles, in which order, until when.

The picture's features are extracted once, whatever number of tiles asks for them. The index ranks the tiles (`index.py`), by the cheapest
kind of features and, where that leaves it open, by the next. A tile that leads by far is asked at once by all means
(`localization/localizer.py`); else the likeliest are asked at a glance, by retrieval alone, until a pose is clear, and the most promising
ones by all means until one answers. Last, tiles that look as much like the picture as the one that answered must not vouch for a pose as
well (`verdict.py`): aliasing grows with the number of places.
"""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.near import Near, tiles_in_reach
from topoloc.atlas.open_maps import Maps
from topoloc.atlas.verdict import Heard, joint_result
from topoloc.bounds import check_bounds
from topoloc.errors import AtlasError, MapError, MissingExtraError, StoreError, WeightsError
from topoloc.features.kinds import KINDS, FeatureConfig, check_available
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.query import Picture, Query, StageClock, reduced_image, unknown_camera
from topoloc.localization.result import Alternative, Localization, NotLocalized, at_time
from topoloc.places.coarse import Image
from topoloc.places.shared_vocabulary import shared_vocabulary

Ranking = list[tuple[str, float]]
"""Tiles with the likeness of their best place, the likeliest first."""


@dataclass(eq=False)
class _Hearing:
    """One picture: what the tiles have said so far, until when others may be asked."""

    picture: Picture
    ranking: Ranking
    deadline: float
    heard: dict[str, Heard] = field(default_factory=dict)

    @property
    def is_late(self) -> bool:
        return time.perf_counter() > self.deadline

    @property
    def left_ms(self) -> float | None:
        """Milliseconds that are left; None where there is no limit."""
        return None if self.deadline == float("inf") else max(1.0, 1e3 * (self.deadline - time.perf_counter()))

    @property
    def is_settled(self) -> bool:
        """Is a pose so well founded that the tile itself asked no further?"""
        return any(one.is_clear for one in self.heard.values())

    @property
    def answers(self) -> list[Heard]:
        """The tiles that vouch for a pose when they are asked by all means."""
        return [one for one in self.heard.values() if one.is_full and isinstance(one.result, Localization)]

    def was_asked(self, tile_id: str) -> bool:
        """By all means?"""
        return tile_id in self.heard and self.heard[tile_id].is_full

    def promise(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Which of several tiles is asked first: the one with the likeliest pose at a glance, then the one that looks most like the
        picture."""
        known = self.heard.get(ranked[0])
        return max((one.probability for one in known.named), default=0.0) if known else 0.0, ranked[1]


class AtlasLocalizer:
    """Answers from an atlas as it was when it was opened.

    `problems` says of tiles that could not be asked why, by their ids; whoever is asked for them goes on without.

    Args:
        maps: opens the tiles and keeps those used last.
        warn: told once of each tile that cannot be asked.

    Raises:
        ConfigError: a setting is out of bounds.
        AtlasError: the atlas has no tile.
    """

    def __init__(self, atlas: Atlas, maps: Maps, config: AtlasConfig | None = None, warn: Callable[[str], None] = warnings.warn) -> None:
        self.atlas, self.config, self._maps, self._warn = atlas, config or AtlasConfig(), maps, warn
        check_bounds(self.config)
        if not atlas.manifest.tiles:
            raise AtlasError(f"the atlas {atlas.store.where} has no tiles; `topoloc atlas add` adds them")
        self.problems: dict[str, str] = {}
        for note in atlas.notes:
            self._warn(note)
        for tile_id, problem in atlas.problems.items():
            self._warn(f"tile {tile_id} is asked after all others: {problem}")
        self._reached: Mapping[str, Rigid3 | None] | None = None
        self._nowhere = ""
        self._focal = max(tile.focal_px for tile in atlas.manifest.tiles)

    def near(self, near: Near | None, placed_only: bool = False) -> AtlasLocalizer:
        """One that asks only tiles in reach of where somebody knows the camera to be (`near.py`); a pose that is given is tried, too.

        Args:
            placed_only: only tiles that know where on earth they lie.

        Raises:
            AtlasError: no tile is of the world that is named.
        """
        other = copy.copy(self)
        other._reached = tiles_in_reach(self.atlas.manifest, near, placed_only)
        other._nowhere = f"no tile lies {near}" if near is not None else "no tile knows where on earth it lies"
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
        """Where was this image (grey or RGB, uint8) taken, and in which tile? As `Localizer.localize`; the result's provenance names the
        tile, in whose world its pose is.

        Args:
            prior: about where the camera is, in the world of the tile `tile_id`, which is then asked alone.
            max_ms: after so many milliseconds no further tile or hypothesis is sought, instead of `config.max_ms`.
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
        clock = StageClock()
        hearing = _Hearing(picture, [] if tile_id is not None else self.rank(picture, clock), deadline)
        ranked = clock.times_ms()
        if tile_id is None:
            self._hear(hearing)
        else:
            self._ask(hearing, self.atlas.tile(tile_id).tile_id, 1.0, prior=prior)
        if not hearing.heard:
            raise AtlasError(f"no tile of the atlas {self.atlas.store.where} can be asked: {next(iter(self.problems.values()), 'no time')}")
        result = self._on_earth(joint_result(list(hearing.heard.values())))
        result = replace(result, times_ms=_all_times(hearing, ranked) | {"total": 1e3 * (time.perf_counter() - start)})
        return result if t_ns is None else at_time(result, t_ns)

    def _on_earth(self, result: Localization | NotLocalized) -> Localization | NotLocalized:
        """With the geoposes of tiles that know through others where on earth they lie."""
        manifest, tile_id = self.atlas.manifest, result.provenance.tile
        if isinstance(result, NotLocalized):
            alternatives = [self._alternative_on_earth(one) for one in result.alternatives]
            return replace(result, alternatives=tuple(alternatives)) if alternatives else result
        place = manifest.georeference_of(manifest.by_id[tile_id]) if tile_id is not None and result.geopose is None else None
        return result if place is None else replace(result, geopose=place.geopose(result.world_from_cam))

    def _alternative_on_earth(self, one: Alternative) -> Alternative:
        manifest = self.atlas.manifest
        place = manifest.georeference_of(manifest.by_id[one.tile]) if one.tile is not None and one.geopose is None else None
        return one if place is None else replace(one, geopose=place.geopose(one.world_from_cam))

    def completed(self, result: NotLocalized, t_ns: int | None = None) -> NotLocalized:
        """What is said of a picture that could not be asked, with its time (nanoseconds)."""
        return result if t_ns is None else at_time(result, t_ns)

    def rank(self, picture: Picture, clock: StageClock | None = None) -> Ranking:
        """The tiles that look most like the picture; behind them those whose places cannot be ranked."""
        sizes = LocalizerConfig()  # those that tiles reduce a picture by, so that they find its features extracted
        image, lens = reduced_image(picture.image, picture.camera, self._focal, sizes.max_finer, sizes.max_side_px)
        index, vectors, ranking = self.atlas.index, {}, Ranking()
        for kind in self._ranked_by:
            vocabulary = shared_vocabulary(kind)
            assert vocabulary is not None
            query = Query(image, lens, 1.0, FeatureConfig(kind=kind), clock or StageClock(), shared=picture.features)
            vectors[kind] = vocabulary.vector(query.features, lens.width, lens.height)
            ranking = index.rank(vectors, self.config.num_ranked, self._reached)
            if _gap(ranking) >= self.config.settled_gap:
                break
        return ranking + [(tile_id, 0.0) for tile_id in self.atlas.problems if self._reached is None or tile_id in self._reached]

    @cached_property
    def _ranked_by(self) -> list[str]:
        """The kinds of features that tiles can be ranked by and that can be had here, the cheapest first."""
        return [kind for kind in KINDS if kind in self.atlas.index.kinds and _is_available(kind)]

    def _hear(self, hearing: _Hearing) -> None:
        """Ask tiles until one answers; then those that look as much like the picture."""
        config, ranking = self.config, self._left(hearing.ranking)
        hopeful = [one for one in ranking if one[1] >= ranking[0][1] - config.hopeless_gap or one[0] in self.atlas.problems]
        if _gap(ranking) < config.settled_gap:
            for tile_id, likeness in hopeful[: config.num_glanced]:
                self._ask(hearing, tile_id, likeness, is_full=False)
                if hearing.is_settled or hearing.is_late:
                    break
        for _ in range(config.num_asked):
            left = [one for one in self._left(hopeful) if not hearing.was_asked(one[0])]
            if not left or hearing.answers or (hearing.heard and hearing.is_late):
                break
            self._ask(hearing, *max(left, key=hearing.promise))
        while not hearing.heard and (left := self._left(hearing.ranking)):  # those that were likely cannot be read
            self._ask(hearing, *left[0])
        self._hear_look_alikes(hearing)

    def _left(self, ranking: Ranking) -> Ranking:
        """Without tiles that cannot be read."""
        return [one for one in ranking if one[0] not in self.problems]

    def _hear_look_alikes(self, hearing: _Hearing) -> None:
        """Tiles that look about as much like the picture as the one that answered, at a glance."""
        if not hearing.answers:
            return
        least = min(answer.likeness for answer in hearing.answers) - self.config.alike_gap
        alike = [(tile_id, likeness) for tile_id, likeness in hearing.ranking if likeness >= least and tile_id not in hearing.heard]
        for tile_id, likeness in alike[: self.config.num_alike]:
            if not hearing.is_late:
                self._ask(hearing, tile_id, likeness, is_full=False)
        for one in [one for one in hearing.heard.values() if one.is_clear and not one.is_full]:  # it may be the answer itself
            self._ask(hearing, one.tile.tile_id, one.likeness)

    def _ask(self, hearing: _Hearing, tile_id: str, likeness: float, is_full: bool = True, prior: Rigid3 | None = None) -> None:
        """Put the picture to a tile; where that cannot be read, the others answer."""
        if tile_id in self.problems:
            hearing.heard.pop(tile_id, None)
            return
        tile = self.atlas.tile(tile_id)
        try:
            with self._maps.lent(tile_id, self._maps.tile_path(self.atlas, tile)) as opened:
                localizer: Localizer = opened.localizer if is_full else opened.localizer.at_first_glance
                known = prior if prior is not None or self._reached is None else self._reached.get(tile_id)
                result, named = localizer.ask(hearing.picture, known, hearing.left_ms)
        except StoreError:  # what the tile would have said nobody knows
            raise
        except MapError as error:
            self.problems[tile_id] = str(error)
            hearing.heard.pop(tile_id, None)
            self._warn(f"tile {tile_id} is not asked: {error}")
            return
        hearing.heard[tile_id] = Heard(tile, result, tuple(one for one, _ in named), is_full, likeness)


def _gap(ranking: Ranking) -> float:
    """By how much the likeliest tile leads the next one; infinite of one tile alone."""
    return ranking[0][1] - ranking[1][1] if len(ranking) > 1 else float("inf")


def _is_available(kind: str) -> bool:
    try:
        check_available(kind)
    except (MissingExtraError, WeightsError):
        return False
    return True


def _all_times(hearing: _Hearing, ranked: dict[str, float]) -> dict[str, float]:
    """Milliseconds of each stage, of all tiles together; `tiles` is that of ranking them, without the features."""
    features = {stage: ms for stage, ms in ranked.items() if stage != "total"}
    total = {**features, "tiles": ranked["total"] - sum(features.values())}
    for one in hearing.heard.values():
        for stage, ms in one.result.times_ms.items():
            total[stage] = total.get(stage, 0.0) + ms
    return total
