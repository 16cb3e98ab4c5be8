"""Results of a query: a pose with its uncertainty, or a reason. No fallback pose exists."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct, structs

from topoloc.errors import ResultError
from topoloc.geometry.calibration_check import CalibrationMismatch, IntrinsicsDeviation
from topoloc.geometry.geodesy import GeoPose
from topoloc.geometry.rigid import Rigid3, standard_deviations
from topoloc.json_data import Count, Finite, NonNegative, OneLine, decode_json
from topoloc.localization.provenance import EMPTY_PROVENANCE, Evidence, Provenance
from topoloc.node_ids import NodeId

Share = Annotated[float, Meta(ge=0, le=1)]
_NodeId = Annotated[NodeId, Meta(ge=0, lt=2**53)]
Reason = Literal[
    "too_few_matches",
    "too_few_inliers",
    "imprecise",
    "ambiguous",
    "not_in_map",
    "jump",
    "unreadable",
]


class CandidateNode(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Hold a node that retrieval found and its score. Higher is better. Scores are comparable
    within one coarse localizer only."""

    node_id: _NodeId
    score: Finite


S = TypeVar("S", bound="_Result")


class _Result:
    """Hold what results of both classes have in common."""

    @classmethod
    def from_json(cls: type[S], line: str | bytes | Mapping[str, Any]) -> S:
        """Parse the output of `to_json`, a text or an object. The image's name is in `provenance`;
        `seen_camera` is lost. Raises ResultError: no result, or one of the other class."""
        result = result_from_json(line)
        if not isinstance(result, cls):
            kind = type(result).__name__
            raise ResultError(f"no {cls.__name__}, but a {kind} ({kind}.from_json reads it)")
        return result


def _to_html(result: Localization | NotLocalized) -> str:
    """Return lines with the pose or the reason, for notebooks."""
    counts = f"{result.num_inliers} inliers of {result.num_matches} matches"
    found = result.alternatives[:8] if isinstance(result, NotLocalized) else ()
    lines = [repr(result), counts, *map(repr, found)]
    return "".join(f"<div>{html.escape(line)}</div>" for line in lines)


@dataclass(frozen=True, eq=False)
class Localization(_Result):
    """Hold the pose `world_from_cam` of an image and its uncertainty.

    Attributes:
        covariance: covariance (6, 6) of the left perturbation xi of world_from_cam,
            ``true_world_from_cam = exp(xi) @ world_from_cam``. Order (translation, rotation),
            metres and radians, world axes. It includes image noise, the uncertainty of each map
            point, and errors that points share in the map or in parts of the image. Its translation
            part refers to the world's origin, `camera_covariance` and `position_covariance` to the
            camera.
        probability: probability that the pose is within 0.25 m and 2 degrees. 5 % of the distance
            of the seen points replaces 0.25 m if that is less. It is computed from `evidence` with
            fitted weights.
        calibrated: False if no weights were fitted to this feature type and those of another are
            used.
        node_id: node with the most inliers.
        times_ms: milliseconds of each stage.
        focal_length_px: focal length estimated with the pose, None if the camera was calibrated.
        noise_share: share of the covariance that is independent from image to image. The rest comes
            from the map and is common to images taken nearby.
        frame_rotation_deg: angle by which a camera with a rolling shutter evidently turned during
            the image. The pose is that of the middle row.
        calibration_doubt: mismatch of the image and its calibration. The pose is by the camera that
            the image shows.
        seen_camera: calibration estimate of this image (`geometry/calibration_check.py`), or None.
        geopose: the camera's pose on earth, if the map is georeferenced (`topoloc georeference`).
        appearance: probability that the colours in view are this floor's and not another's, if both
            were as likely. The probability includes it. None if the image or the map is grey, or if
            colours were weighed with the pixels (`exact/pixel_evidence.py`).
    """

    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    node_id: NodeId
    candidates: list[CandidateNode]
    num_matches: int
    num_inliers: int
    times_ms: dict[str, float] = field(default_factory=dict)
    evidence: Evidence | None = None
    focal_length_px: float | None = None
    noise_share: float = 1.0
    calibrated: bool = True
    provenance: Provenance = EMPTY_PROVENANCE
    geopose: GeoPose | None = None
    frame_rotation_deg: float | None = None
    calibration_doubt: CalibrationMismatch | None = None
    seen_camera: IntrinsicsDeviation | None = None
    appearance: float | None = None

    def __repr__(self) -> str:
        sigmas = f"{self.position_sigma_text}, {self.rotation_sigma_deg:.2f} deg"
        p = f"{self.probability:.3f}, node {self.node_id}"
        return f"Localization({self.world_from_cam}, sigma {sigmas}, p {p})"

    _repr_html_ = _to_html

    @property
    def localized(self) -> Literal[True]:
        """Return True. Type checkers tell the classes apart by `isinstance` or `is True`."""
        return True

    @property
    def is_of_nodes(self) -> bool:
        """Return whether the place was recognised by the map's nodes, not by virtual views, which
        serve where nearby nodes show another side."""
        return self.evidence is None or self.evidence.is_of_nodes

    @property
    def position_sigma_m(self) -> float:
        """Return the root mean square position error by `camera_covariance`, metres, or units
        of a map without scale."""
        return standard_deviations(self.camera_covariance)[0]

    @property
    def position_sigma_text(self) -> str:
        """Return `position_sigma_m` with its unit, cm, or units of a map without scale."""
        sigma = self.position_sigma_m
        return f"{100 * sigma:.1f} cm" if self.provenance.has_scale else f"{sigma:.2g} units"

    @property
    def rotation_sigma_deg(self) -> float:
        """Return the root mean square rotation error (degrees) by `camera_covariance`."""
        return math.degrees(standard_deviations(self.camera_covariance)[1])

    @property
    def camera_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Return that of xi in ``true_world_from_cam = world_from_cam @ exp(xi)``."""
        return self.world_from_cam.inverse().transform_covariance(self.covariance)

    @property
    def position_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Return the covariance of the camera's position (m^2), in the axes of the world."""
        rotation = self.world_from_cam.rotation
        return rotation @ self.camera_covariance[:3, :3] @ rotation.T

    def to_json(self, query: str | None = None) -> dict[str, Any]:
        """Return one line of the result file with the image's name, see docs/cli.md."""
        optional = {
            "focal_length_px": self.focal_length_px,
            "noise_share": self.noise_share if self.noise_share != 1.0 else None,
            "evidence": self.evidence and asdict(self.evidence),
            "frame_rotation_deg": self.frame_rotation_deg,
            "calibration_doubt": self.calibration_doubt and self.calibration_doubt.to_json(),
            "geopose": self.geopose and self.geopose.to_json(),
        }
        has_scale = self.provenance.has_scale
        return {
            "query": self.provenance.query if query is None else query,
            "localized": True,
            "world_from_cam": self.world_from_cam.to_json(),
            "covariance": self.covariance.tolist(),
            "position_sigma_m" if has_scale else "position_sigma": self.position_sigma_m,
            "rotation_sigma_deg": self.rotation_sigma_deg,
            "probability": self.probability,
            **({} if self.calibrated else {"calibrated": False}),
            "node": self.node_id,
            **_evidence_json(self),
            **{name: value for name, value in optional.items() if value is not None},
        }


class Alternative(OneLine, Struct, frozen=True, eq=False, rename={"node_id": "node"}):
    """Hold one possible pose of an ambiguous image, or that of an imprecise one, and its
    probability.

    The probabilities of all alternatives sum to less than 1. The rest is the probability of none of
    them. `geopose` and `covariance` are as in `Localization`. `tile` is the atlas tile in whose
    world the pose is.
    """

    world_from_cam: Rigid3
    probability: Share
    node_id: _NodeId
    geopose: GeoPose | None = None
    tile: str | None = None
    covariance: Float[np.ndarray, "6 6"] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the alternative as a JSON object."""
        pose = {
            "world_from_cam": self.world_from_cam.to_json(),
            "probability": self.probability,
            "node": self.node_id,
        }
        pose |= {} if self.tile is None else {"tile": self.tile}
        pose |= {} if self.covariance is None else {"covariance": self.covariance.tolist()}
        return pose if self.geopose is None else pose | {"geopose": self.geopose.to_json()}


@dataclass(frozen=True, eq=False)
class NotLocalized(_Result):
    """Report that no pose is certain enough, with the `reason`.

    `alternatives` holds the possible poses of an `ambiguous` image, likeliest first, or the pose of
    an `imprecise` one."""

    reason: Reason
    candidates: list[CandidateNode] = field(default_factory=list)
    num_matches: int = 0
    num_inliers: int = 0
    times_ms: dict[str, float] = field(default_factory=dict)
    detail: str = ""
    alternatives: tuple[Alternative, ...] = ()
    provenance: Provenance = EMPTY_PROVENANCE
    seen_camera: IntrinsicsDeviation | None = None
    appearance: float | None = None

    def __repr__(self) -> str:
        text = ": ".join(filter(None, [self.reason, " ".join(self.detail.split())]))
        return f"NotLocalized({text if len(text) < 180 else text[:177] + '...'})"

    _repr_html_ = _to_html

    @property
    def localized(self) -> Literal[False]:
        """Return False."""
        return False

    def to_json(self, query: str | None = None) -> dict[str, Any]:
        """Return one line of the result file with the image's name, see docs/cli.md."""
        alternatives = [one.to_json() for one in self.alternatives]
        query = self.provenance.query if query is None else query
        refusal = {"query": query, "localized": False, "reason": self.reason, "detail": self.detail}
        return refusal | {"alternatives": alternatives} | _evidence_json(self)


R = TypeVar("R", bound=Localization | NotLocalized)


def result_from_json(line: str | bytes | Mapping[str, Any]) -> Localization | NotLocalized:
    """Parse a result of either class. Raises ResultError: it is not a result."""
    data = decode_json(line, dict[str, Any], ResultError, "no result")
    is_localized = data.get("localized") is True
    kind = _LocalizedLine if is_localized else _RefusedLine
    read = decode_json(data, kind, ResultError, "no result")
    values: dict[str, Any] = structs.asdict(read) | {"provenance": Provenance.from_json(data)}
    del values["localized"]
    return Localization(**values) if is_localized else NotLocalized(**values)


def with_time(result: R, t_ns: int) -> R:
    """Return the result with the capture time of its image, nanoseconds."""
    return replace(result, provenance=replace(result.provenance, t_ns=t_ns))


def _evidence_json(result: Localization | NotLocalized) -> dict[str, Any]:
    return {
        "candidates": [[c.node_id, round(c.score, 4)] for c in result.candidates],
        "num_matches": result.num_matches,
        "num_inliers": result.num_inliers,
        "times_ms": {stage: round(ms, 3) for stage, ms in result.times_ms.items()},
        **({} if result.appearance is None else {"appearance": result.appearance}),
        **result.provenance.to_json(),
    }


class _Line(Struct, frozen=True, kw_only=True, rename={"node_id": "node"}):
    """Hold the keys of a result's JSON, by the names of the fields of the result."""

    localized: bool
    candidates: Annotated[list[CandidateNode], Meta(max_length=10_000)]
    num_matches: Count
    num_inliers: Count
    times_ms: dict[str, Finite]
    appearance: Share | None = None


class _LocalizedLine(_Line, frozen=True, kw_only=True):
    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: Share
    node_id: _NodeId
    evidence: Evidence | None = None
    focal_length_px: NonNegative | None = None
    noise_share: Share = 1.0
    calibrated: bool = True
    geopose: GeoPose | None = None
    frame_rotation_deg: NonNegative | None = None
    calibration_doubt: CalibrationMismatch | None = None

    def __post_init__(self) -> None:
        diagonal = np.diag(self.covariance)
        slack = 1e-6 * np.sqrt(np.abs(np.outer(diagonal, diagonal))) + 1e-300
        if (diagonal < 0.0).any() or (np.abs(self.covariance - self.covariance.T) > slack).any():
            raise ValueError("covariance is not symmetric, or has a negative variance")


class _RefusedLine(_Line, frozen=True, kw_only=True):
    reason: Reason
    detail: str = ""
    alternatives: Annotated[tuple[Alternative, ...], Meta(max_length=10_000)] = ()
