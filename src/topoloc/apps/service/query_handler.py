"""Run one query in a worker: decode the image, find its camera, localize it, write the result. No
step uses the event loop.

An atlas is reopened when its manifest changes. A thread for each object store checks its manifest
every few seconds. While a store is silent, the last version is served.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from topoloc import (
    Atlas,
    AtlasConfig,
    Camera,
    FeatureTypeError,
    Image,
    Localization,
    Localizer,
    MapCache,
    MapError,
    NotLocalized,
    ObjectStoreError,
    QueryError,
    TopolocError,
    TopoMetricMap,
    UncalibratedCamera,
    WeightsError,
    read_image,
)
from topoloc.apps.core_names import Deadline
from topoloc.apps.report.explanation import explain, explanation_to_json
from topoloc.apps.report.explanation_page import compared_to_json, explanation_page
from topoloc.apps.service.logs import log
from topoloc.apps.service.query_request import QueryRequest, parse_camera_field
from topoloc.apps.service.request_errors import RequestError, without_folders
from topoloc.plugin import EncodedImage, image_size

POLL_INTERVAL_S = 5.0
"""Seconds between two checks of an object store: one listing each, and a reading if it changed."""
T = TypeVar("T")
Results = dict[str, Localization | NotLocalized]


class ServedAtlases:
    """Hold a localizer for each atlas. The service's cache of maps opens their tiles."""

    def __init__(self, maps: MapCache[Localizer], config: AtlasConfig) -> None:
        self._maps, self._config = maps, config
        self._watched = {watched.where: watched for watched in maps.atlases}
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._opened: dict[str, tuple[Atlas, Localizer]] = {}

    def opened(self) -> list[tuple[Atlas, Localizer]]:
        """Return the current version of each atlas with its localizer. Raises AtlasError."""
        with self._lock:
            return [self._open_localizer(where) for where in self._watched]

    def watch(self) -> None:
        """Check the atlases in object stores until `close`."""
        for where, watched in self._watched.items():
            if watched.is_remote:
                poll = partial(self._poll_atlas, where)
                threading.Thread(target=poll, name="atlas", daemon=True).start()

    def close(self) -> None:
        """Stop the checks, without waiting for one in progress."""
        self._ended.set()

    def _open_localizer(self, where: str) -> tuple[Atlas, Localizer]:
        atlas, known = self._watched[where].now(), self._opened.get(where)
        if known is None or known[0] is not atlas:
            localizer = Localizer(atlas, tiles=self._config, maps=self._maps, warn=_warn)
            self._opened[where] = known = atlas, localizer
        return known

    def _poll_atlas(self, where: str) -> None:
        watched, logged = self._watched[where], ""
        while not self._ended.wait(POLL_INTERVAL_S):
            try:
                if watched.look():
                    log("atlas", where=where, serial=watched.now().manifest.serial)
                logged = ""
            except Exception as error:  # the next check may succeed; the last version is served
                if str(error) != logged:
                    unknown = None if isinstance(error, TopolocError) else error
                    log("atlas", logging.WARNING, unknown, where=where, detail=str(error))
                logged = str(error)


def _warn(text: str) -> None:
    log("tile", logging.WARNING, detail=text)


class Failures(dict[str, TopolocError]):
    """The faults of maps that cannot be read, by name."""

    @contextmanager
    def leaving_out(self, name: str) -> Iterator[None]:
        """Add a fault of this map instead of raising it, so that the others answer. A silent object
        store is raised: it may answer the next time."""
        try:
            yield
        except ObjectStoreError:
            raise
        except (MapError, FeatureTypeError, WeightsError) as error:
            log("left out", logging.WARNING, map=name, detail=str(error))
            self[name] = error

    def check_any(self, results: Mapping[str, object]) -> None:
        """Raise the first fault if there are no results."""
        if self and not results:
            raise next(iter(self.values()))


@dataclass(frozen=True, eq=False)
class QueryHandler:
    """Localize images in the maps of the service. Searches end after `max_ms` milliseconds."""

    maps: MapCache[Localizer]
    decoder: ImageDecoder
    max_ms: float
    atlases: ServedAtlases

    def localize(self, name: str, query_request: QueryRequest) -> Localization | NotLocalized:
        """Localize in one map. Raises RequestError; TopolocError: image, camera or map is bad."""
        return self._run_query(name, query_request, self._localize_image)

    def localize_everywhere(self, query_request: QueryRequest) -> tuple[Results, Failures]:
        """Localize in every map and every atlas of the service. Those that are left share the time
        that is left. Return the results, and the faults of maps that cannot be read; raise the
        first if none can."""
        opened, answers, failures = self.atlases.opened(), Results(), Failures()
        end = time.perf_counter() + self._limit_ms(query_request.max_ms) / 1e3
        tiles = {tile_id for _, localizer in opened for tile_id in localizer.tile_ids}
        places = [(name, None) for name in self.maps.names() if name not in tiles]
        places += [(atlas.name, localizer) for atlas, localizer in opened]
        for number, (name, atlas) in enumerate(places):
            if query_request.stop.is_set():
                break
            remaining_ms = max(1.0, 1e3 * (end - time.perf_counter()) / (len(places) - number))
            limited = replace(query_request, max_ms=remaining_ms)
            with failures.leaving_out(name):
                if atlas is None:
                    answers[name] = self.localize(name, limited)
                else:
                    result = self._localize_in_atlas(atlas, limited)
                    answers[result.provenance.tile or ""] = result
        failures.check_any(answers)
        return answers, failures

    def _localize_in_atlas(
        self, localizer: Localizer, query_request: QueryRequest
    ) -> Localization | NotLocalized:
        if query_request.prior is not None:
            raise QueryError("a prior is a pose in one map's world: ask that map")
        image, camera = self.decode_query(query_request, None)
        localizer = localizer if query_request.near is None else localizer.near(query_request.near)
        deadline = self.deadline_of(query_request.stop, query_request.max_ms)
        return localizer.localize(image, camera, max_ms=deadline)

    def explain(self, name: str, query_request: QueryRequest, as_page: bool) -> str:
        """Explain the result of an image as a page or as JSON."""

        def explain_image(
            localizer: Localizer,
            image: Image,
            camera: Camera | UncalibratedCamera,
            query_request: QueryRequest,
        ) -> str:
            deadline, query = Deadline(stop=query_request.stop), query_request.picture.name
            explanation = explain(localizer, image, camera, deadline)
            if as_page:
                return explanation_page(query, image, explanation, localizer.topomap)
            compared = compared_to_json(image, explanation, localizer.topomap)
            return json.dumps(
                explanation_to_json(query, explanation)
                | {"picture_size": [image.shape[1], image.shape[0]], "compared": compared}
            )

        return self._run_query(name, query_request, explain_image)

    def decode_query(
        self, query_request: QueryRequest, topomap: TopoMetricMap | None
    ) -> tuple[Image, Camera | UncalibratedCamera]:
        """Return the image and its camera."""
        picture = query_request.picture
        image, size = self.decoder.decode(picture)
        camera = parse_camera_field(query_request.camera, picture, size, topomap)
        return image, adapt_camera(camera, size, image)

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
        deadline = self.deadline_of(query_request.stop, query_request.max_ms)
        return localizer.localize(image, camera, query_request.prior, deadline)

    def deadline_of(self, stop: threading.Event, max_ms: float | None = None) -> Deadline:
        """Return the end of a search that begins now. `stop` ends it before."""
        return Deadline(time.perf_counter() + self._limit_ms(max_ms) / 1e3, stop)

    def _limit_ms(self, max_ms: float | None) -> float:
        return min(max_ms or self.max_ms, self.max_ms)


class ImageDecoder:
    """Decode images of at most `max_pixels`. All workers together decode that many at a time."""

    def __init__(self, max_pixels: int) -> None:
        self._max_pixels = self._num_free = max_pixels
        self._condition = threading.Condition()

    def decode(self, picture: EncodedImage) -> tuple[Image, tuple[int, int]]:
        """Return an image, and its width and height before it is reduced to 12.5 megapixels.
        Raises UnreadableImageError: it is no image, or damaged; RequestError: it is too large."""
        width, height = image_size(picture)
        num_pixels = width * height
        if num_pixels > self._max_pixels:
            most = f"{self._max_pixels / 1e6:g} megapixels"
            raise RequestError(413, f"{picture}: {width}x{height} is more than {most}")
        with self._condition:
            self._condition.wait_for(lambda: num_pixels <= self._num_free)
            self._num_free -= num_pixels
        try:
            return read_image(picture, max_pixels=12_500_000), (width, height)
        finally:
            with self._condition:
                self._num_free += num_pixels
                self._condition.notify_all()


def adapt_camera(
    camera: Camera | UncalibratedCamera, size: tuple[int, int], image: Image
) -> Camera | UncalibratedCamera:
    """Return the camera of an image of this width and height for the image as it was decoded."""
    height, width = image.shape[:2]
    is_reduced = (width, height) != size == (camera.width, camera.height)
    return camera.rescaled(width, height) if is_reduced else camera


def result_to_line(result: Localization | NotLocalized, query: str) -> str:
    """Return the result as a JSON line, as `topoloc localize` prints it."""
    return json.dumps(result.to_json(query))


def combine_results(answers: Results, failures: Failures, query: str) -> dict[str, Any]:
    """Return the results of several maps, those with a pose first. If several have one, the client
    chooses, because maps may overlap."""
    found = {name: result for name, result in answers.items() if isinstance(result, Localization)}
    ranked = sorted(answers, key=lambda name: -found[name].probability if name in found else 1.0)
    (only,) = found if len(found) == 1 else (None,)
    rows = [{"map": name, "result": answers[name].to_json(query)} for name in ranked]
    failed = [
        {"map": name, "error": without_folders(str(error))} for name, error in failures.items()
    ]
    whole = {"query": query, "localized": bool(found), "map": only}
    return whole | {"answers": rows, "failed": failed}
