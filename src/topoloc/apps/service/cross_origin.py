"""Requests from pages of other sites (CORS): the allowed origins, and the response headers that
browsers check."""

from __future__ import annotations

from collections.abc import Collection
from urllib.parse import urlsplit

ANY_ORIGIN = "*"
_DEFAULT_PORTS = {"http": ":80", "https": ":443"}
_PREFLIGHT = {
    "access-control-allow-methods": "GET, POST, DELETE",
    "access-control-allow-headers": "Authorization, Content-Type, Accept, X-Request-Id",
    "access-control-max-age": "600",
}


def parse_origin(text: str) -> str:
    """Return an origin as browsers send it, or `*`. Raises ValueError with the fault."""
    if text == ANY_ORIGIN:
        return text
    parts, origin = urlsplit(text), text.lower()
    try:
        is_origin = bool(parts.hostname) and parts.port != 0 and "@" not in text
    except ValueError:  # the port is no number
        is_origin = False
    if not is_origin or origin != f"{parts.scheme}://{parts.netloc}".lower() or "*" in text:
        raise ValueError(f"{text[:80]}: an origin is like https://app.example, without a path")
    return origin.removesuffix(_DEFAULT_PORTS.get(parts.scheme, ""))


class CrossOrigin:
    """Holds the allowed origins. Returns the headers of responses."""

    def __init__(self, origins: Collection[str]) -> None:
        self._origins = frozenset(origins)

    def allows(self, origin: str, host: str) -> bool:
        """Return whether requests from pages of this origin are allowed under this host name.
        Programs send no origin."""
        return not origin or _is_own(origin, host) or self._is_listed(origin)

    def response_headers(self, origin: str) -> dict[str, str]:
        """Return the headers of every response, also of a refusal. Without them a browser hides it
        from the page."""
        if not self._origins:
            return {}
        if not self._is_listed(origin):
            return {"vary": "Origin"}
        return {
            "access-control-allow-origin": origin,
            "access-control-expose-headers": "X-Request-Id, Retry-After",
            "vary": "Origin",
        }

    def preflight_headers(self, is_private_network: bool) -> dict[str, str]:
        """Return the headers of the response to a preflight. `is_private_network`: the browser
        checks access from the internet to this network, too."""
        private = {"access-control-allow-private-network": "true"} if is_private_network else {}
        return _PREFLIGHT | private

    def _is_listed(self, origin: str) -> bool:
        listed = origin.lower() in self._origins or ANY_ORIGIN in self._origins
        return bool(origin) and listed


def _is_own(origin: str, host: str) -> bool:
    return urlsplit(origin).netloc.lower() == host.lower()
