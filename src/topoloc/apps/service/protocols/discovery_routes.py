"""Discovery over HTTP as in SpatialDDS 1.6: which maps of this service cover a region."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from hashlib import sha256
from itertools import product
from pathlib import PurePath
from typing import Annotated, Any
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import ValidationError

from topoloc import TopoMetricMap
from topoloc.apps.service.openapi_schemas import OBJECT_RESPONSE, error_responses, request_body
from topoloc.apps.service.protocols.discovery_messages import (
    SEARCH_EXAMPLE,
    Announced,
    SearchRequest,
    SearchResponse,
    enclose,
    parse_resource,
)
from topoloc.apps.service.protocols.geopose_messages import ROUTE
from topoloc.apps.service.query_handler import Failures
from topoloc.apps.service.query_request import read_body
from topoloc.apps.service.request_errors import RequestError, invalid_request
from topoloc.apps.service.state import Service, get_service

router = APIRouter(prefix="/.well-known", tags=["discovery"])
_HEADERS = {"cache-control": f"private, max-age={Announced.ttl_s}"}


@router.get("/spatialdds", include_in_schema=False)
async def get_bootstrap() -> Response:
    """Refuse: a bootstrap manifest names a domain of DDS and its peers."""
    raise RequestError(404, "no DDS domain is served; search at /.well-known/spatialdds/search")


@router.get("/spatialdds-resolver", responses=OBJECT_RESPONSE | error_responses(401, 403))
async def get_resolver(request: Request) -> JSONResponse:
    """Return where URIs of this service are resolved."""
    authority, base = _address(request)
    place = {"authority": authority, "https_base": f"{base}/.well-known/spatialdds/resolve"}
    return JSONResponse(place | {"cache_ttl_sec": Announced.ttl_s}, headers=_HEADERS)


@router.get(
    "/spatialdds/resolve",
    responses=OBJECT_RESPONSE | error_responses(400, 401, 403, 404, 422, 429, 503),
)
async def resolve(request: Request, uri: Annotated[str, Query(max_length=2000)]) -> JSONResponse:
    """Return the manifest of a spatialdds URI."""
    parts = parse_resource(uri)
    if parts is None:
        raise RequestError(400, "uri: spatialdds://AUTHORITY/maps/service/NAME is expected")
    service, (authority, base) = get_service(request), _address(request)
    for one in await service.run_job(request, lambda: _announced(service)):
        if parts == (authority, one.resource):
            manifest = one.manifest(authority, base)
            digest = sha256(repr(manifest).encode()).hexdigest()[:32]
            return JSONResponse(manifest, headers=_HEADERS | {"etag": f'"{digest}"'})
    raise RequestError(404, f"there is no service {uri[:200]} here")


@router.get(
    "/spatialdds/search",
    response_model=SearchResponse,
    responses=error_responses(400, 401, 403, 422, 429, 503),
)
async def search_by_geohash(
    request: Request,
    geohash: Annotated[str, Query(max_length=20, examples=["u15"])] = "",
    kind: Annotated[str | None, Query(max_length=20, examples=["VPS"])] = None,
) -> JSONResponse:
    """Return the services that cover a cell."""
    query = {"geohash": geohash, "kind": [] if kind is None else [kind]}
    return await _search(request, lambda: SearchRequest.model_validate(query))


@router.post(
    "/spatialdds/search",
    response_model=SearchResponse,
    responses=error_responses(400, 401, 403, 408, 413, 429, 503),
    openapi_extra=request_body(SearchRequest, SEARCH_EXAMPLE),
)
async def search(request: Request) -> JSONResponse:
    """Return the services that cover one of the regions, or the geohash."""
    body = await read_body(request)
    return await _search(request, lambda: SearchRequest.model_validate_json(body))


async def _search(request: Request, parse: Callable[[], SearchRequest]) -> JSONResponse:
    service, address = get_service(request), _address(request)

    def find() -> dict[str, Any]:
        try:
            query = parse()
        except ValidationError as error:
            raise invalid_request("search", error) from None
        found = [one for one in _announced(service) if query.matches(one.box)]
        start, end = (int(query.page_token or 0) + one for one in (0, min(query.max_results, 100)))
        manifests = [one.manifest(*address) for one in found[start:end]]
        return {"results": manifests, "next_page_token": str(end) if end < len(found) else ""}

    return JSONResponse(await service.run_job(request, find), headers=_HEADERS)


def _announced(service: Service) -> list[Announced]:
    """Return all maps and atlases with a place on earth. They are looked at once a minute."""
    now = time.time()
    if service.announced is None or now - service.announced[0] > Announced.ttl_s:
        service.announced = now, list(_look(service, int(now)))
    return service.announced[1]


def _look(service: Service, now_s: int) -> Iterator[Announced]:
    tiles = set[str]()
    for atlas, localizer in service.query_handler.atlases.opened():
        tiles |= set(localizer.tile_ids)
        boxes = [one.geo_box for one in atlas.manifest.tiles if one.geo_box is not None]
        if corners := [corner for box in boxes for corner in (box[:2], box[2:])]:
            name, serial = PurePath(atlas.store.where).name, atlas.manifest.serial
            yield Announced(name, serial, enclose(corners), ROUTE, now_s)
    for name in (one for one in service.maps.names() if one not in tiles):
        with Failures().leaving_out(name), service.maps.use_map(name) as opened:
            topomap = opened.content.topomap
            path = f"{ROUTE}?map={quote(name, safe='')}"
            if corners := _corners(topomap):
                yield Announced(name, topomap.version, enclose(corners), path, now_s)


def _corners(topomap: TopoMetricMap) -> list[tuple[float, float]]:
    """Return latitude and longitude of the corners around all nodes; none without a place on
    earth."""
    centres, place = topomap.node_poses.centres, topomap.georeference
    if place is None or not len(centres):
        return []
    corners = np.array(list(product(*zip(centres.min(axis=0), centres.max(axis=0), strict=True))))
    return [(point.lat, point.lon) for point in map(place.geopoint, corners)]


def _address(request: Request) -> tuple[str, str]:
    """Return the authority and the address of the service, as the client knows them."""
    return (request.url.hostname or "localhost").lower(), str(request.base_url).rstrip("/")
