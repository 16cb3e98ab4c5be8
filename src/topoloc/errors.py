"""Define the known failures, which the command line prints as one line each. Any other exception is
a bug and shows its traceback.

TopolocError
├── RecordingError            a recording, or one of its files, is unreadable or inconsistent
│   ├── UnknownFormatError    no format recognises the folder
│   ├── CalibrationError      the calibration is missing or not usable
│   └── UnreadableImageError  an image is missing, empty, truncated or too large
├── TrajectoryError           a trajectory has NaN, bad rotations, or times that match no frame
│   └── DuplicateSessionError a recording is already in the map
├── MapError                  a map cannot be opened, read or written
│   ├── MapVersionError       a later topoloc wrote the map, with an unknown schema
│   ├── EmptyMapError         no node could be built, or the map has none
│   ├── MapNotFoundError      no map has the given name
│   └── AtlasError            an atlas cannot be opened, read or written, or a tile is refused
│       └── ObjectStoreError  an object store does not answer, or its files cannot be stored here
├── WeightsError              weights are missing, damaged or of another network
├── TrainingError             a training cannot start or continue (no data, loss not finite)
├── ConfigError               a setting is unknown, of the wrong type or out of bounds
├── QueryError                a query is invalid (no camera, camera of another image size)
├── ResultError               a JSON line is not a result
├── GeoreferenceError         no place on earth, or points that fix no georeference
├── FeatureTypeError          a feature type is unknown, or its fitted weights are damaged
├── ServiceError              a service does not answer, or refuses the request
├── ClusterError              a cluster does not answer, or has another version
└── MissingExtraError         an optional dependency is not installed
"""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import contextmanager


class TopolocError(Exception):
    """Report a failure that the user can understand and fix. The text is one line with the problem
    and its place."""

    def __str__(self) -> str:
        return "\\n".join(super().__str__().splitlines())  # it may quote a text of a file

    @classmethod
    @contextmanager
    def at(cls, place: object, *caught: type[Exception]) -> Iterator[None]:
        """Raise errors of the block as this class, with their place before the text. `caught` are
        the classes of these errors, by default this class. Of an OSError only the reason stays."""
        kinds = caught or (cls,)
        try:
            yield
        except kinds as error:
            reason = (isinstance(error, OSError) and error.strerror) or error
            raise cls(f"{place}: {reason}") from None


class RecordingError(TopolocError):
    """Report a recording that cannot be read."""


class UnknownFormatError(RecordingError):
    """Report a path that no known format recognises."""


class CalibrationError(RecordingError):
    """Report a missing or unusable calibration."""


class UnreadableImageError(RecordingError):
    """Report an image file that is missing, empty, truncated, too large or not an image."""


class TrajectoryError(TopolocError):
    """Report a trajectory that is malformed or matches no frame of the recording."""


class DuplicateSessionError(TrajectoryError):
    """Report that a recording to be added to a map is already in it."""


class MapError(TopolocError):
    """Report a map file that cannot be opened, read or written."""


class MapVersionError(MapError):
    """Report a map file whose schema this version does not support."""


class EmptyMapError(MapError):
    """Report a map without a usable node."""


class MapNotFoundError(MapError):
    """Report that no map has the given name."""


class AtlasError(MapError):
    """Report an atlas that cannot be opened, read or written, or a tile that it cannot accept."""


class ObjectStoreError(AtlasError):
    """Report an object store that does not answer, or whose files cannot be stored on this machine.
    The content of the files is not at fault, and a later attempt may succeed."""


class WeightsError(TopolocError):
    """Report network weights that are missing, damaged, or belong to another network."""


class TrainingError(TopolocError):
    """Report a training that cannot start or continue."""


class ConfigError(TopolocError):
    """Report a setting that is unknown, of the wrong type or out of its bounds. The text names its
    key."""


class QueryError(TopolocError):
    """Report an invalid query: it has no camera, or a camera of another image size."""


class ResultError(TopolocError):
    """Report a JSON line that is not the result of a query."""


class GeoreferenceError(TopolocError):
    """Report a place that is not on earth, or points that do not determine the place of a map on
    it."""


class FeatureTypeError(TopolocError):
    """Report an unknown feature type or unreadable fitted weights. The text names the feature types
    or the file."""


class ServiceError(TopolocError):
    """Report a service that does not answer or that refuses a request. `status` is its HTTP status,
    or None without an answer."""

    def __init__(self, text: str, status: int | None = None) -> None:
        super().__init__(text)
        self.status = status


class ClusterError(TopolocError):
    """Report a cluster that does not answer, is not a cluster, or has another version."""


_NOT_ON_ARM = ("carla", "colmap", "ros")  # the conditions in pyproject.toml


class MissingExtraError(TopolocError):
    """Report a missing optional dependency. The text names the extra that installs it."""

    @classmethod
    @contextmanager
    def on_import(cls, text: str, extra: str) -> Iterator[None]:
        """Raise this error if an import of another package fails in the block. The text ends with
        the command that installs `extra`. ``{}`` in it is replaced by the name of the module."""
        try:
            yield
        except ImportError as error:
            if (error.name or "").startswith("topoloc"):
                raise
            need = text.replace("{}", error.name or str(error))
            remedy = f"pip install 'topoloc[{extra}]'"
            if extra in _NOT_ON_ARM and platform.machine() == "aarch64":
                remedy = "its library has no package for Linux on ARM; use a machine with x86-64"
            raise cls(f"{need}: {remedy}") from error
