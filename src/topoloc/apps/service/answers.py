"""What a worker does: the picture decoded, its camera made out, the map asked, the answer written.
No step of it touches the loop."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from topoloc.apps.report.explanation import explain, facts_of
from topoloc.apps.report.explanation_page import compared_json, explanation_page
from topoloc.apps.service.asked import Asked
from topoloc.apps.service.query_cameras import camera_named
from topoloc.apps.service.refusals import Refusal
from topoloc.apps.service.served_atlases import ServedAtlases
from topoloc.atlas.atlas_localizer import AtlasLocalizer
from topoloc.atlas.open_maps import Maps, OpenedMap
from topoloc.errors import QueryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import Image
from topoloc.recordings.pictures import PictureBytes, image_size, read_image

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Answerer:
    """Answers from these maps; pictures of more than `max_pixels` are refused, searches end after
    `max_ms`."""

    maps: Maps
    max_pixels: int
    max_ms: float
    atlases: ServedAtlases

    def localize(self, name: str, asked: Asked) -> Localization | NotLocalized:
        """Raises Refusal, and TopolocError of the picture, its camera or the map."""
        return self._asked(name, asked, self._localized)

    def localize_everywhere(self, asked: Asked) -> dict[str, Localization | NotLocalized]:
        """By every map of the service, and by each atlas, of which the tile answers that knows most
        of the picture; the time that is left is shared by those that are still to be asked."""
        localizers, end = (
            self.atlases.localizers(),
            time.perf_counter() + self._limit_ms(asked) / 1e3,
        )
        tiles = {tile_id for localizer in localizers for tile_id in localizer.atlas.manifest.by_id}
        names = [name for name in self.maps.names() if name not in tiles]
        answers, num_left = dict[str, Localization | NotLocalized](), len(names) + len(localizers)
        for one in [*names, *localizers]:
            left_ms = max(1.0, 1e3 * (end - time.perf_counter()) / num_left)
            limited, num_left = replace(asked, max_ms=left_ms), num_left - 1
            if isinstance(one, str):
                answers[one] = self.localize(one, limited)
            else:
                result = self._localized_in_atlas(one, limited)
                answers[result.provenance.tile or ""] = result
        return answers

    def _localized_in_atlas(
        self, localizer: AtlasLocalizer, asked: Asked
    ) -> Localization | NotLocalized:
        if asked.prior is not None:
            raise QueryError("a prior is a pose in one map's world: ask that map")
        image = decoded_picture(asked.picture, self.max_pixels)
        camera = camera_named(asked.camera, asked.picture, (image.shape[1], image.shape[0]), None)
        localizer = localizer if asked.near is None else localizer.near(asked.near)
        return localizer.localize(image, camera, max_ms=asked.max_ms)

    def explain(self, name: str, asked: Asked, as_page: bool) -> str:
        """Why the picture got its answer: a page, or JSON."""

        def explained(
            opened: OpenedMap, image: Image, camera: Camera | RoughCamera, asked: Asked
        ) -> str:
            explanation, query = explain(opened.localizer, image, camera), asked.picture.name
            if as_page:
                return explanation_page(query, image, explanation, opened.localizer.topomap)
            compared = compared_json(image, explanation, opened.localizer.topomap)
            return json.dumps(
                facts_of(query, explanation)
                | {"picture_size": [image.shape[1], image.shape[0]], "compared": compared}
            )

        return self._asked(name, asked, explained)

    def decoded(self, asked: Asked, topomap: TopoMetricMap) -> tuple[Image, Camera | RoughCamera]:
        """The picture and its camera."""
        image = decoded_picture(asked.picture, self.max_pixels)
        return image, camera_named(
            asked.camera, asked.picture, (image.shape[1], image.shape[0]), topomap
        )

    def _asked(
        self,
        name: str,
        asked: Asked,
        ask: Callable[[OpenedMap, Image, Camera | RoughCamera, Asked], T],
    ) -> T:
        with self.maps.lent(name) as opened:
            image, camera = self.decoded(asked, opened.localizer.topomap)
            return ask(opened, image, camera, asked)

    def _localized(
        self, opened: OpenedMap, image: Image, camera: Camera | RoughCamera, asked: Asked
    ) -> Localization | NotLocalized:
        return opened.localizer.localize(image, camera, asked.prior, self._limit_ms(asked))

    def _limit_ms(self, asked: Asked) -> float:
        return min(asked.max_ms or self.max_ms, self.max_ms)


def decoded_picture(picture: PictureBytes, max_pixels: int) -> Image:
    """Its size is looked at before anything is decoded.

    Raises:
        UnreadableImageError: it is no picture, or a damaged one.
        Refusal: it is too large.
    """
    width, height = image_size(picture)
    if width * height > max_pixels:
        raise Refusal(
            413, f"{picture}: {width}x{height} is more than {max_pixels / 1e6:g} megapixels"
        )
    return read_image(picture)


def line_of(result: Localization | NotLocalized, query: str) -> str:
    """As the command line prints it."""
    return json.dumps(result.to_json(query))


def of_all_maps(answers: dict[str, Localization | NotLocalized], query: str) -> dict[str, Any]:
    """The answers of several maps, those that vouch for a pose first. Where several do, whoever
    asks must choose: maps may overlap."""
    found = {name: result for name, result in answers.items() if isinstance(result, Localization)}
    ranked = sorted(answers, key=lambda name: -found[name].probability if name in found else 1.0)
    (only,) = found if len(found) == 1 else (None,)
    rows = [{"map": name, "result": answers[name].to_json(query)} for name in ranked]
    return {"query": query, "localized": bool(found), "map": only, "answers": rows}
