"""Known failures, one line each on the command line; anything else is a bug and shows its
traceback.

TopolocError
├── RecordingError        a recording (or one file of it) that cannot be read or makes no sense
│   ├── UnknownFormatError    no format recognises the folder
│   ├── CalibrationError      no calibration, or one that is not usable
│   └── UnreadableImageError  an image that is missing, empty, truncated or too large
├── TrajectoryError       a trajectory file with NaN, bad rotations, or times that match no frame
│   └── SessionKnownError     a recording that is in the map already
├── MapError              a map that cannot be opened, read or written
│   ├── MapVersionError       written by a later topoloc, schema unknown here
│   ├── EmptyMapError         no node could be built, or the map holds none
│   ├── UnknownMapError       no map of this name where maps are asked for by name
│   └── AtlasError            an atlas that cannot be opened, read or written, or two tiles of one
id │       └── StoreError            an object store that does not answer, or not in time ├──
WeightsError          weights of a network that are missing, damaged or of another network ├──
TrainingError         a training that cannot begin or go on: nothing to learn from, a loss that is
not finite ├── ConfigError           a setting that is unknown, of the wrong type or out of its
bounds; names the key ├── QueryError            the call of a query is wrong (no camera, camera of
another image size) ├── ResultError           a result (a JSON line) that is none ├──
GeoreferenceError     no place on earth, or points that do not say where a map lies on it ├──
FeatureKindError      features of a kind that there is not, or whose fitted weights are damaged ├──
ClusterError          a cluster that does not answer, or is of another version ├── ServiceError
a service that does not answer, or refuses └── MissingExtraError     an optional dependency is not
installed; names the extra
"""


class TopolocError(Exception):
    """A failure that the user can understand and mend: its text is one line, saying what and
    where."""


class RecordingError(TopolocError):
    """A recording that cannot be read."""


class UnknownFormatError(RecordingError):
    """No known format recognises this path."""


class CalibrationError(RecordingError):
    """Missing or unusable calibration."""


class UnreadableImageError(RecordingError):
    """An image file that is missing, empty, truncated, too large or no image at all."""


class TrajectoryError(TopolocError):
    """A trajectory that is malformed or fits no frame of the recording."""


class DuplicateSessionError(TrajectoryError):
    """A recording that is to join a map and is in it already."""


class MapError(TopolocError):
    """A map file that cannot be opened, read or written."""


class MapVersionError(MapError):
    """A map file of a schema that this version does not know."""


class EmptyMapError(MapError):
    """A map without a single usable node."""


class MapNotFoundError(MapError):
    """No map of this name."""


class AtlasError(MapError):
    """An atlas that cannot be opened, read or written, or a tile that it cannot take."""


class ObjectStoreError(AtlasError):
    """An object store that does not answer, or whose files cannot be kept here: nothing is said of
    what they hold, and later it may go."""


class WeightsError(TopolocError):
    """Weights of a network that are missing, damaged, or those of another network."""


class TrainingError(TopolocError):
    """A training that cannot begin or go on."""


class ConfigError(TopolocError):
    """A setting that is unknown, of the wrong type or out of its bounds; the text names its key."""


class QueryError(TopolocError):
    """A query that cannot be asked: no camera, or a camera of another image size."""


class ResultError(TopolocError):
    """A JSON line that is no result of a query."""


class GeoreferenceError(TopolocError):
    """A place that is none on earth, or points that do not determine where a map lies."""


class FeatureTypeError(TopolocError):
    """Features of an unknown kind, or fitted weights that cannot be read; the text names the kinds
    or the file."""


class ServiceError(TopolocError):
    """A service that does not answer, or refuses; `status` is its HTTP status, None where there was
    no answer."""

    def __init__(self, text: str, status: int | None = None) -> None:
        super().__init__(text)
        self.status = status


class ClusterError(TopolocError):
    """A cluster that does not answer, is none, or is of another version."""


class MissingExtraError(TopolocError):
    """An optional dependency is missing; the text names the extra that brings it."""
