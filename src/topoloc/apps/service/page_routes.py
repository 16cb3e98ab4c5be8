"""The page at `/`: its files, and the scene of each map that it shows."""

from __future__ import annotations

import base64
import json
from functools import cache
from hashlib import sha256
from importlib import resources
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from fastapi.responses import HTMLResponse, Response

from topoloc.apps.service.openapi_schemas import error_responses
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, get_service
from topoloc.apps.viewer.document import SceneBudget, create_document
from topoloc.apps.viewer.page import MODULES, import_map, static_text

router = APIRouter()
_PAGE_MODULES = MODULES | {
    f"topoloc/page/{name}": f"page/{name}.js" for name in ("page", "asking", "live", "matches")
}
_TYPES = {
    ".js": "text/javascript",
    ".css": "text/css",
    ".html": "text/html",
    ".LICENSE": "text/plain",
    ".md": "text/plain",
}
_BUDGET = SceneBudget()
_NUM_CACHED_SCENES = 4


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
async def page() -> Response:
    """The page, which asks this service alone."""
    text, policy = _render_page()
    return HTMLResponse(
        text, headers={"content-security-policy": policy, "referrer-policy": "no-referrer"}
    )


@router.get("/static/{name:path}", include_in_schema=False)
async def static(name: str) -> Response:
    """A file of the page."""
    if name not in _load_static_files():
        raise RequestError(404, f"nothing is at /static/{name[:80]}")
    media_type = _TYPES[name[name.rindex(".") :]]
    return Response(
        static_text(name),
        media_type=media_type,
        headers={"cache-control": "no-cache", "x-content-type-options": "nosniff"},
    )


@router.get("/v1/maps/{map}/scene", responses=error_responses(401, 404, 422, 429, 503))
async def scene(request: Request, map: Annotated[str, Path(max_length=200)]) -> Response:
    """What a map looks like: points, nodes with their pictures, paths; as docs/viewer.md says.
    `topoloc view` makes pages of the same."""
    service = get_service(request)
    body = await service.run_job(request, lambda: _build_scene(service, map))
    return Response(body, media_type="application/json")


def _build_scene(service: Service, name: str) -> bytes:
    """The document of a map, as long as its file is the same."""
    kept = service.scenes
    with service.maps.use_map(name) as opened:
        if name in kept and kept[name][0] == opened.stamp:
            return kept[name][1]
        body = json.dumps(
            create_document(opened.content.topomap, name, budget=_BUDGET), separators=(",", ":")
        ).encode()
        kept.pop(name, None)
        while len(kept) >= _NUM_CACHED_SCENES:
            kept.pop(next(iter(kept)), None)
        kept[name] = opened.stamp, body
        return body


@cache
def _render_page() -> tuple[str, str]:
    """The page's text, and the policy that keeps it from asking, or running, anything else."""
    element = import_map(lambda file: f"/static/{file}", _PAGE_MODULES)
    inside = element[element.index(">") + 1 : element.rindex("<")]
    digest = base64.b64encode(sha256(inside.encode()).digest()).decode("ascii")
    policy = (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self'"
        " 'unsafe-inline'; img-src 'self' data: blob:; media-src 'self' blob:; connect-src 'self';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return static_text("page/page.html").replace("<!--import map-->", element), policy


@cache
def _load_static_files() -> frozenset[str]:
    root: Any = resources.files("topoloc.apps.viewer").joinpath("static")
    folders = [("", root), ("page/", root.joinpath("page"))]
    return frozenset(
        prefix + file.name
        for prefix, folder in folders
        for file in folder.iterdir()
        if file.is_file()
    )
