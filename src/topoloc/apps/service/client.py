"""Query a service from Python. Results are those of a `Localizer`."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
from jaxtyping import Float

from topoloc import Camera, Localization, NotLocalized, Rigid3, ServiceError, result_from_json

ImageInput = str | Path | bytes | np.ndarray
CameraSpec = Camera | str | None
"""A camera, or a camera option of the service: `map`, `unknown`, `exif`, `fx,fy,cx,cy`."""
Position = Sequence[float] | Float[np.ndarray, " 3"]
_MAX_TRIES, _MAX_WAIT_S = 5, 10.0


class Client:
    """Query a service that `topoloc serve` runs. A context manager; `close` closes its connection.

    If too many requests wait, the service names a delay, and the request is repeated a few times.

    Args:
        url: the address, as ``http://127.0.0.1:8571``.
        token: the content of the service's `--token-file`.
        timeout_s: time limit of a response, seconds.
    """

    def __init__(self, url: str, token: str | None = None, timeout_s: float = 60.0) -> None:
        self._http = httpx.Client(**_client_options(url, token, timeout_s))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def maps(self) -> list[str]:
        """Return the names of the service's maps. Raises ServiceError."""
        return self._send(_get_request())["maps"]

    def map(self, name: str) -> dict[str, Any]:
        """Return the content of a map as `topoloc info --json`, with its nodes. Raises
        ServiceError."""
        return self._send(_get_request(name))

    def localize(
        self,
        map: str,
        image: ImageInput,
        camera: CameraSpec = None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
    ) -> Localization | NotLocalized:
        """Localize an image in a map.

        Args:
            image: a file, its bytes, or an array (H, W) or RGB (H, W, 3), uint8.
            camera: its calibration. None takes the focal length of EXIF, or estimates it.
            prior: approximate pose of the camera, world_from_cam.
            max_ms: time limit of the search for poses, milliseconds.

        Raises:
            ServiceError: the service does not respond, or refuses with a reason.
        """
        request = _image_request(map, "/localize", image, camera, prior, max_ms)
        return result_from_json(self._send(request))

    def localize_everywhere(
        self, image: ImageInput, camera: CameraSpec = None, max_ms: float | None = None
    ) -> dict[str, Any]:
        """Localize an image in all maps of the service: `{"map": ..., "answers": [{"map": ...,
        "result": ...}]}`. Raises ServiceError."""
        return self._send(_image_request(None, "/localize", image, camera, None, max_ms))

    def explain(self, map: str, image: ImageInput, camera: CameraSpec = None) -> dict[str, Any]:
        """Return the reasons for an image's result, as `topoloc explain --json`. Raises
        ServiceError."""
        return self._send(_image_request(map, "/explain", image, camera))

    def scene(self, map: str) -> dict[str, Any]:
        """Return a map for display: points, nodes and paths, as docs/viewer.md describes. Raises
        ServiceError."""
        return self._send(_get_request(map, "/scene"))

    def notes(self, map: str) -> list[dict[str, Any]]:
        """Return the notes of a map, the oldest first: `id`, `text`, `created`, `position` (metres,
        axes of the map's world), and `geopose` if the map has a place on earth. Raises
        ServiceError."""
        return self._send(_get_request(map, "/notes"))["notes"]

    def add_note(self, map: str, text: str, position: Position) -> str:
        """Add a note at a position (metres, axes of the map's world), and return its id. Raises
        ServiceError."""
        return self._send(_note_request(map, text, position))["id"]

    def remove_note(self, map: str, note_id: str) -> None:
        """Delete a note. Raises ServiceError: there is no such note."""
        self._send(_get_request(map, f"/notes/{quote(note_id, safe='')}") | {"method": "DELETE"})

    def _send(self, request: dict[str, Any]) -> Any:
        attempts = count(1)
        while True:
            with _translate_errors(self._http):
                response = self._http.request(**request)
            if (wait_s := _retry_delay_s(response, next(attempts))) is None:
                return _parse_response(response)
            time.sleep(wait_s)


class AsyncClient:
    """`Client` for programs with an event loop: the same methods as coroutines."""

    def __init__(self, url: str, token: str | None = None, timeout_s: float = 60.0) -> None:
        self._http = httpx.AsyncClient(**_client_options(url, token, timeout_s))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        await self._http.aclose()

    async def maps(self) -> list[str]:
        """As `Client.maps`."""
        return (await self._send(_get_request()))["maps"]

    async def map(self, name: str) -> dict[str, Any]:
        """As `Client.map`."""
        return await self._send(_get_request(name))

    async def localize(
        self,
        map: str,
        image: ImageInput,
        camera: CameraSpec = None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
    ) -> Localization | NotLocalized:
        """As `Client.localize`."""
        request = _image_request(map, "/localize", image, camera, prior, max_ms)
        return result_from_json(await self._send(request))

    async def localize_everywhere(
        self, image: ImageInput, camera: CameraSpec = None, max_ms: float | None = None
    ) -> dict[str, Any]:
        """As `Client.localize_everywhere`."""
        return await self._send(_image_request(None, "/localize", image, camera, None, max_ms))

    async def explain(
        self, map: str, image: ImageInput, camera: CameraSpec = None
    ) -> dict[str, Any]:
        """As `Client.explain`."""
        return await self._send(_image_request(map, "/explain", image, camera))

    async def scene(self, map: str) -> dict[str, Any]:
        """As `Client.scene`."""
        return await self._send(_get_request(map, "/scene"))

    async def notes(self, map: str) -> list[dict[str, Any]]:
        """As `Client.notes`."""
        return (await self._send(_get_request(map, "/notes")))["notes"]

    async def add_note(self, map: str, text: str, position: Position) -> str:
        """As `Client.add_note`."""
        return (await self._send(_note_request(map, text, position)))["id"]

    async def remove_note(self, map: str, note_id: str) -> None:
        """As `Client.remove_note`."""
        note = f"/notes/{quote(note_id, safe='')}"
        await self._send(_get_request(map, note) | {"method": "DELETE"})

    async def _send(self, request: dict[str, Any]) -> Any:
        attempts = count(1)
        while True:
            with _translate_errors(self._http):
                response = await self._http.request(**request)
            if (wait_s := _retry_delay_s(response, next(attempts))) is None:
                return _parse_response(response)
            await asyncio.sleep(wait_s)


def _client_options(url: str, token: str | None, timeout_s: float) -> dict[str, Any]:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return {"base_url": url, "headers": headers, "timeout": timeout_s}


def _get_request(map: str | None = None, part: str = "") -> dict[str, Any]:
    """Return the arguments of httpx's `request` for a map or a part of it, or for the list of
    maps."""
    return {
        "method": "GET",
        "url": "/v1/maps" if map is None else f"/v1/maps/{quote(map, safe='')}{part}",
    }


def _note_request(map: str, text: str, position: Position) -> dict[str, Any]:
    note = {"text": text, "position": np.asarray(position, float).tolist()}
    return _get_request(map, "/notes") | {"method": "POST", "json": note}


def _image_request(
    map: str | None,
    action: str,
    image: ImageInput,
    camera: CameraSpec,
    prior: Rigid3 | None = None,
    max_ms: float | None = None,
) -> dict[str, Any]:
    """Return the arguments of httpx's `request` for an image and a map, or all maps."""
    data = {
        "camera": json.dumps(camera.to_json()) if isinstance(camera, Camera) else camera,
        "prior": prior
        and json.dumps(
            {"translation": prior.translation.tolist(), "quat_wxyz": prior.quat_wxyz().tolist()}
        ),
        "max_ms": max_ms,
    }
    return {
        "method": "POST",
        "url": f"/v1{action}" if map is None else _get_request(map, action)["url"],
        "data": {name: value for name, value in data.items() if value is not None},
        "files": {"image": _encode_image(image)},
    }


def _encode_image(image: ImageInput) -> tuple[str, bytes]:
    """Return a name and the bytes of an image. Arrays are encoded without loss."""
    if isinstance(image, bytes):
        return "image", image
    if isinstance(image, np.ndarray):
        import cv2

        pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        return "image", cv2.imencode(".png", pixels)[1].tobytes()
    with ServiceError.at(image, OSError):
        return Path(image).name, Path(image).read_bytes()


def _retry_delay_s(response: httpx.Response, attempt: int) -> float | None:
    """Return the delay before the request is repeated, seconds. None if this is the response."""
    if response.status_code != 429 or attempt == _MAX_TRIES:
        return None
    named = response.headers.get("retry-after", "1")
    return min(float(named), _MAX_WAIT_S) if named.isdigit() else 1.0


def _parse_response(response: httpx.Response) -> Any:
    if response.status_code == 204:
        return None
    try:
        data = response.json()
    except ValueError:
        status = response.status_code
        raise ServiceError(
            f"{response.url}: no answer of a topoloc service (status {status})", status
        ) from None
    if response.status_code >= 400:
        text = data.get("error") if isinstance(data, dict) else None
        raise ServiceError(
            f"{text or 'refused'} (status {response.status_code})", response.status_code
        )
    return data


@contextmanager
def _translate_errors(http: httpx.Client | httpx.AsyncClient) -> Iterator[None]:
    """Convert connection errors to ServiceError."""
    try:
        yield
    except httpx.HTTPError as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise ServiceError(f"{http.base_url}: no answer ({text})") from error
