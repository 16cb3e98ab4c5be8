"""What a request is refused with: a status of HTTP, and one sentence."""

from __future__ import annotations

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
    """Ends a request with this status and sentence; `retry_after_s` says when to come again."""

    def __init__(self, status: int, text: str, retry_after_s: int | None = None) -> None:
        super().__init__(text)
        self.status, self.text, self.retry_after_s = status, text, retry_after_s

    @property
    def headers(self) -> dict[str, str]:
        return {} if self.retry_after_s is None else {"Retry-After": str(self.retry_after_s)}


# Failures of what lies here and not of the request; every other known failure is the request's.
_SERVER_ERRORS = (MapError, WeightsError, MissingExtraError)


def to_request_error(error: Exception) -> RequestError:
    """How a failure while a request was answered is told."""
    if isinstance(error, RequestError):
        return error
    if isinstance(error, MapNotFoundError):
        return RequestError(404, str(error))
    if isinstance(error, ObjectStoreError):
        return RequestError(503, str(error), retry_after_s=5)
    if isinstance(error, _SERVER_ERRORS):
        return RequestError(503, str(error), retry_after_s=30)
    if isinstance(error, UnreadableImageError):
        return RequestError(400, str(error))
    if isinstance(error, TopolocError):
        return RequestError(422, str(error))
    if isinstance(error, MemoryError):
        return RequestError(
            503, "out of memory; a smaller picture, or this one later, may do", retry_after_s=5
        )
    return RequestError(
        503,
        "the worker failed while it answered this request; the log of the service says more",
        retry_after_s=1,
    )
