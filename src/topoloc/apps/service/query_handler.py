"""Run one query in a worker: decode the image, find its camera, localize it, write the result. No
step uses the event loop."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from topoloc import (
    Camera,
    Image,
    Localization,
    Localizer,
    MapCache,
    NotLocalized,
    QueryError,
    TopoMetricMap,
    UncalibratedCamera,
    read_image,
)
from topoloc.apps.report.explanation import explain, explanation_to_json
from topoloc.apps.report.explanation_page import compared_to_json, explanation_page
from topoloc.apps.service.query_request import QueryRequest, parse_camera_field
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.served_atlases import ServedAtlases
from topoloc.plugin import EncodedImage, image_size

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class QueryHandler:
    """Localize images in the maps of the service. Images of more than `max_pixels` are refused, and
    searches end after `max_ms` milliseconds."""

    maps: MapCache[Localizer]
    max_pixels: int
    max_ms: float
    atlases: ServedAtlases

    def localize(self, name: str, query_request: QueryRequest) -> Localization | NotLocalized:
        """Localize in one map. Raises RequestError; TopolocError: image, camera or map is bad."""
        return self._run_query(name, query_request, self._localize_image)

    def localize_everywhere(
        self, query_request: QueryRequest
    ) -> dict[str, Localization | NotLocalized]:
        """Localize in every map and every atlas of the service. Those that are left share the time
        that is left."""
        localizers, end = (
            [localizer for _, localizer in self.atlases.opened()],
            time.perf_counter() + self._limit_ms(query_request) / 1e3,
        )
        tiles = {tile_id for localizer in localizers for tile_id in localizer.tile_ids}
        names = [name for name in self.maps.names() if name not in tiles]
        answers, num_left = dict[str, Localization | NotLocalized](), len(names) + len(localizers)
        for one in [*names, *localizers]:
            remaining_ms = max(1.0, 1e3 * (end - time.perf_counter()) / num_left)
            limited, num_left = replace(query_request, max_ms=remaining_ms), num_left - 1
            if isinstance(one, str):
                answers[one] = self.localize(one, limited)
            else:
                result = self._localize_in_atlas(one, limited)
                answers[result.provenance.tile or ""] = result
        return answers

    def _localize_in_atlas(
        self, localizer: Localizer, query_request: QueryRequest
    ) -> Localization | NotLocalized:
        if query_request.prior is not None:
            raise QueryError("a prior is a pose in one map's world: ask that map")
        image = decode_image(query_request.picture, self.max_pixels)
        camera = parse_camera_field(
            query_request.camera, query_request.picture, (image.shape[1], image.shape[0]), None
        )
        localizer = localizer if query_request.near is None else localizer.near(query_request.near)
        return localizer.localize(image, camera, max_ms=query_request.max_ms)

    def explain(self, name: str, query_request: QueryRequest, as_page: bool) -> str:
        """Explain the result of an image as a page or as JSON."""

        def explain_image(
            localizer: Localizer,
            image: Image,
            camera: Camera | UncalibratedCamera,
            query_request: QueryRequest,
        ) -> str:
            explanation, query = (
                explain(localizer, image, camera),
                query_request.picture.name,
            )
            if as_page:
                return explanation_page(query, image, explanation, localizer.topomap)
            compared = compared_to_json(image, explanation, localizer.topomap)
            return json.dumps(
                explanation_to_json(query, explanation)
                | {"picture_size": [image.shape[1], image.shape[0]], "compared": compared}
            )

        return self._run_query(name, query_request, explain_image)

    def decode_query(
        self, query_request: QueryRequest, topomap: TopoMetricMap
    ) -> tuple[Image, Camera | UncalibratedCamera]:
        """Return the image and its camera."""
        image = decode_image(query_request.picture, self.max_pixels)
        return image, parse_camera_field(
            query_request.camera, query_request.picture, (image.shape[1], image.shape[0]), topomap
        )

    def _run_query(
        self,
        name: str,
        query_request: QueryRequest,
        run: Callable[[Localizer, Image, Camera | UncalibratedCamera, QueryRequest], T],
    ) -> T:
        with self.maps.use_map(name) as opened:
            image, camera = self.decode_query(query_request, opened.content.topomap)
            return run(opened.content, image, camera, query_request)

    def _localize_image(
        self,
        localizer: Localizer,
        image: Image,
        camera: Camera | UncalibratedCamera,
        query_request: QueryRequest,
    ) -> Localization | NotLocalized:
        return localizer.localize(image, camera, query_request.prior, self._limit_ms(query_request))

    def _limit_ms(self, query_request: QueryRequest) -> float:
        return min(query_request.max_ms or self.max_ms, self.max_ms)


def decode_image(picture: EncodedImage, max_pixels: int) -> Image:
    """Decode an image, after a check of its size.

    Raises:
        UnreadableImageError: it is no image, or damaged.
        RequestError: it is too large.
    """
    width, height = image_size(picture)
    if width * height > max_pixels:
        raise RequestError(
            413, f"{picture}: {width}x{height} is more than {max_pixels / 1e6:g} megapixels"
        )
    return read_image(picture)


def result_to_line(result: Localization | NotLocalized, query: str) -> str:
    """Return the result as a JSON line, as `topoloc localize` prints it."""
    return json.dumps(result.to_json(query))


def combine_results(answers: dict[str, Localization | NotLocalized], query: str) -> dict[str, Any]:
    """Return the results of several maps, those with a pose first. If several have one, the client
    chooses, because maps may overlap."""
    found = {name: result for name, result in answers.items() if isinstance(result, Localization)}
    ranked = sorted(answers, key=lambda name: -found[name].probability if name in found else 1.0)
    (only,) = found if len(found) == 1 else (None,)
    rows = [{"map": name, "result": answers[name].to_json(query)} for name in ranked]
    return {"query": query, "localized": bool(found), "map": only, "answers": rows}
