"""Errors of HTTP requests: a status and one sentence."""

from __future__ import annotations

import re

from pydantic import ValidationError

from topoloc import (
    MapError,
    MapNotFoundError,
    MissingExtraError,
    ObjectStoreError,
    TopolocError,
    UnreadableImageError,
    WeightsError,
)


class RequestError(Exception):
    """End a request with this status and sentence. `retry_after_s` becomes Retry-After."""

    def __init__(self, status: int, text: str, retry_after_s: int | None = None) -> None:
        super().__init__(text)
        self.status, self.text, self.retry_after_s = status, text, retry_after_s

    @property
    def headers(self) -> dict[str, str]:
        """HTTP headers of the response."""
        return {} if self.retry_after_s is None else {"Retry-After": str(self.retry_after_s)}

    def to_json(self, request_id: str) -> dict[str, str]:
        """Return the body of the response."""
        return {"error": " ".join(self.text.split()), "request_id": request_id}


def invalid_request(problem: str, error: ValidationError) -> RequestError:
    """Return the first fault of JSON, with its place."""
    first = error.errors(include_input=False, include_url=False)[0]
    fault = first["msg"].removeprefix("Value error, ")
    return RequestError(
        400, ": ".join(filter(None, (problem, ".".join(map(str, first["loc"])), fault)))
    )


def to_request_error(error: Exception) -> RequestError:
    """Convert any error raised during a request."""
    if isinstance(error, RequestError):
        return error
    if isinstance(error, MapNotFoundError):
        return RequestError(404, without_folders(str(error)))
    if isinstance(error, ObjectStoreError):
        return RequestError(503, str(error), 5)
    if isinstance(error, MapError | WeightsError | MissingExtraError):
        return RequestError(503, without_folders(str(error)), 30)
    if isinstance(error, TopolocError):
        return RequestError(400 if isinstance(error, UnreadableImageError) else 422, str(error))
    if isinstance(error, MemoryError):
        return RequestError(503, "out of memory; send a smaller image, or try again later", 5)
    return RequestError(503, "the worker failed at this request; see the log of the service", 1)


def without_folders(text: str) -> str:
    """Leave the names of files alone. The log has the folders, which are no matter of clients."""
    return re.sub(r"(?<![\w:/])/(?:[^\s/:]+/)+", "", text)
