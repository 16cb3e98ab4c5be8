"""A service asked from Python: results come as they come from a `Localizer`."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from topoloc import (
    Camera,
    Localization,
    MissingExtraError,
    NotLocalized,
    Rigid3,
    ServiceError,
    result_from_json,
)

if TYPE_CHECKING:
    import httpx

ImageInput = str | Path | bytes | np.ndarray
CameraSpec = Camera | str | None
"""A camera, or what the service calls one: `map`, `unknown`, `exif`, `fx,fy,cx,cy`."""
_MAX_TRIES, _MAX_WAIT_S = 5, 10.0


@dataclass(frozen=True)
class _ClientRequest:
    """One request, whoever sends it."""

    method: str
    path: str
    data: dict[str, str] | None = None
    picture: tuple[str, bytes] | None = None

    def options(self) -> dict[str, Any]:
        return {} if self.picture is None else {"data": self.data, "files": {"image": self.picture}}


class Client:
    """A service that `topoloc serve` runs. A context manager; `close` lets go of its connection.

    Where the service says that too many wait, it is asked again after the time that it names, a few
    times.

    Args:
        url: its address, as ``http://127.0.0.1:8571``.
        token: what its `--token-file` holds.
        timeout_s: how long an answer may take, seconds.

    Raises:
        MissingExtraError: httpx is not installed.
    """

    def __init__(self, url: str, token: str | None = None, timeout_s: float = 60.0) -> None:
        self._http = _import_httpx().Client(**_client_options(url, token, timeout_s))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def maps(self) -> list[str]:
        """The names of its maps. Raises ServiceError."""
        return self._send_request(_ClientRequest("GET", "/v1/maps"))["maps"]

    def map(self, name: str) -> dict[str, Any]:
        """What a map holds, as `topoloc info --json` says it, with its nodes. Raises
        ServiceError."""
        return self._send_request(_ClientRequest("GET", f"/v1/maps/{_quote_name(name)}"))

    def localize(
        self,
        map: str,
        image: ImageInput,
        camera: CameraSpec = None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
    ) -> Localization | NotLocalized:
        """Where in this map was the picture taken?

        Args:
            image: a file, its bytes, or an array (H, W) or RGB (H, W, 3), uint8.
            camera: its calibration; None takes what EXIF says of the focal length, else finds it.
            prior: about where the camera is, world_from_cam.
            max_ms: after so many milliseconds no further pose is sought.

        Raises:
            ServiceError: the service does not answer, or refuses; its text says why.
        """
        return result_from_json(
            self._send_request(
                _localize_request(
                    f"/v1/maps/{_quote_name(map)}/localize", image, camera, prior, max_ms
                )
            )
        )

    def localize_everywhere(
        self, image: ImageInput, camera: CameraSpec = None, max_ms: float | None = None
    ) -> dict[str, Any]:
        """By all maps of the service: `{"map": ..., "answers": [{"map": ..., "result": ...}]}`.
        Raises ServiceError."""
        return self._send_request(_localize_request("/v1/localize", image, camera, None, max_ms))

    def explain(self, map: str, image: ImageInput, camera: CameraSpec = None) -> dict[str, Any]:
        """Why the picture gets its answer, as `topoloc explain --json`. Raises ServiceError."""
        return self._send_request(
            _localize_request(f"/v1/maps/{_quote_name(map)}/explain", image, camera, None, None)
        )

    def _send_request(self, request: _ClientRequest) -> Any:
        for tries_left in reversed(range(_MAX_TRIES)):
            try:
                response = self._http.request(request.method, request.path, **request.options())
            except _import_httpx().HTTPError as error:
                raise _connection_error(self._http, error) from error
            wait_s = _retry_delay_s(response) if tries_left else None
            if wait_s is None:
                return _parse_response(response)
            time.sleep(wait_s)
        raise AssertionError("the last try answers or raises")


class AsyncClient:
    """`Client` for programs that run in an event loop: the same methods, each to be awaited."""

    def __init__(self, url: str, token: str | None = None, timeout_s: float = 60.0) -> None:
        self._http = _import_httpx().AsyncClient(**_client_options(url, token, timeout_s))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        await self._http.aclose()

    async def maps(self) -> list[str]:
        """As `Client.maps`."""
        return (await self._send_request(_ClientRequest("GET", "/v1/maps")))["maps"]

    async def map(self, name: str) -> dict[str, Any]:
        """As `Client.map`."""
        return await self._send_request(_ClientRequest("GET", f"/v1/maps/{_quote_name(name)}"))

    async def localize(
        self,
        map: str,
        image: ImageInput,
        camera: CameraSpec = None,
        prior: Rigid3 | None = None,
        max_ms: float | None = None,
    ) -> Localization | NotLocalized:
        """As `Client.localize`."""
        return result_from_json(
            await self._send_request(
                _localize_request(
                    f"/v1/maps/{_quote_name(map)}/localize", image, camera, prior, max_ms
                )
            )
        )

    async def localize_everywhere(
        self, image: ImageInput, camera: CameraSpec = None, max_ms: float | None = None
    ) -> dict[str, Any]:
        """As `Client.localize_everywhere`."""
        return await self._send_request(
            _localize_request("/v1/localize", image, camera, None, max_ms)
        )

    async def explain(
        self, map: str, image: ImageInput, camera: CameraSpec = None
    ) -> dict[str, Any]:
        """As `Client.explain`."""
        return await self._send_request(
            _localize_request(f"/v1/maps/{_quote_name(map)}/explain", image, camera, None, None)
        )

    async def _send_request(self, request: _ClientRequest) -> Any:
        import asyncio

        for tries_left in reversed(range(_MAX_TRIES)):
            try:
                response = await self._http.request(
                    request.method, request.path, **request.options()
                )
            except _import_httpx().HTTPError as error:
                raise _connection_error(self._http, error) from error
            wait_s = _retry_delay_s(response) if tries_left else None
            if wait_s is None:
                return _parse_response(response)
            await asyncio.sleep(wait_s)
        raise AssertionError("the last try answers or raises")


def _import_httpx() -> Any:
    try:
        import httpx
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "asking a service needs httpx: pip install 'topoloc[serve]'"
        ) from error
    return httpx


def _client_options(url: str, token: str | None, timeout_s: float) -> dict[str, Any]:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return {"base_url": url, "headers": headers, "timeout": timeout_s}


def _localize_request(
    path: str, image: ImageInput, camera: CameraSpec, prior: Rigid3 | None, max_ms: float | None
) -> _ClientRequest:
    said = {"camera": json.dumps(camera.to_json()) if isinstance(camera, Camera) else camera}
    if prior is not None:
        said["prior"] = json.dumps(
            {"translation": prior.translation.tolist(), "quat_wxyz": prior.quat_wxyz().tolist()}
        )
    if max_ms is not None:
        said["max_ms"] = str(max_ms)
    return _ClientRequest(
        "POST",
        path,
        {name: value for name, value in said.items() if value is not None},
        _encode_image(image),
    )


def _encode_image(image: ImageInput) -> tuple[str, bytes]:
    """Name and bytes; an array goes without loss."""
    if isinstance(image, bytes):
        return "image", image
    if isinstance(image, np.ndarray):
        import cv2

        pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        return "image", cv2.imencode(".png", pixels)[1].tobytes()
    try:
        return Path(image).name, Path(image).read_bytes()
    except OSError as error:
        raise ServiceError(f"{image}: {error.strerror}") from None


def _quote_name(name: str) -> str:
    from urllib.parse import quote

    return quote(name, safe="")


def _retry_delay_s(response: httpx.Response) -> float | None:
    """Seconds after which to ask again; None where this is the answer."""
    if response.status_code != 429:
        return None
    named = response.headers.get("retry-after", "1")
    return min(float(named), _MAX_WAIT_S) if named.isdigit() else 1.0


def _parse_response(response: httpx.Response) -> Any:
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


def _connection_error(http: httpx.Client | httpx.AsyncClient, error: Exception) -> ServiceError:
    return ServiceError(
        f"{http.base_url}: no answer ({' '.join(str(error).split()) or type(error).__name__})"
    )
