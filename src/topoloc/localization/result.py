"""Results of a query: a pose with its uncertainty, or a reason for none. No fallback pose
exists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from jaxtyping import Float

from topoloc.errors import GeoreferenceError, ResultError
from topoloc.geometry.calibration_mismatch import (
    MISMATCH_FOCAL_FIELDS,
    CalibrationMismatch,
    IntrinsicsDeviation,
)
from topoloc.geometry.geodesy import GeoPose
from topoloc.geometry.rigid import Rigid3
from topoloc.localization import checked_json as checked
from topoloc.localization.checked_json import pose_to_json
from topoloc.localization.evidence import Evidence
from topoloc.localization.provenance import EMPTY_PROVENANCE, Provenance
from topoloc.retrieval.coarse import NodeScore

Reason = Literal[
    "too_few_matches", "too_few_inliers", "ambiguous", "not_in_map", "jump", "unreadable"
]


@dataclass(frozen=True, eq=False)
class Localization:
    """Hold the pose `world_from_cam` of an image and its uncertainty.

    Attributes:
        covariance: covariance (6, 6) of the left perturbation xi of world_from_cam,
            ``true_world_from_cam = exp(xi) @ world_from_cam``. Order (translation, rotation),
            metres and radians, world axes. It includes the image noise, the uncertainty of each map
            point and the correlated errors of the map (`correlated_errors.py`). It also includes
            errors shared within parts of the image, such as moved objects
            (`geometry/clustered_errors.py`). The translation part refers to the world's origin.
            `camera_covariance` refers to the camera.
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
        calibration_doubt: mismatch of the image and its calibration. The covariance and probability
            include it.
        seen_camera: calibration estimate of this image, None if there is none.
            `calibration_consistency.py` combines those of many images.
        geopose: the camera's pose on earth, if the map is georeferenced (`topoloc georeference`).
    """

    world_from_cam: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    probability: float
    node_id: int
    candidates: list[NodeScore]
    num_matches: int
    num_inliers: int
    times_ms: dict[str, float] = field(default_factory=dict)
    evidence: Evidence | None = None
    focal_length_px: float | None = None
    noise_share: float = 1.0
    calibrated: bool = True
    provenance: Provenance = EMPTY_PROVENANCE
    geopose: GeoPose | None = None
    calibration_doubt: CalibrationMismatch | None = None
    seen_camera: IntrinsicsDeviation | None = None

    @property
    def localized(self) -> Literal[True]:
        """Return True."""
        return True

    @property
    def is_from_virtual_views(self) -> bool:
        """Return whether the place was recognised by virtual views, because nearby nodes show
        another side."""
        return self.evidence is not None and self.evidence.is_from_virtual_views

    @property
    def position_sigma_m(self) -> float:
        """Return the root mean square position error (metres) by `camera_covariance`."""
        return float(np.sqrt(np.trace(self.camera_covariance[:3, :3])))

    @property
    def rotation_sigma_deg(self) -> float:
        """Return the root mean square rotation error (degrees) by `camera_covariance`."""
        return float(np.rad2deg(np.sqrt(np.trace(self.camera_covariance[3:, 3:]))))

    @property
    def camera_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Return `covariance` in the camera frame.

        It is that of xi in ``true_world_from_cam = world_from_cam @ exp(xi)``.
        """
        adjoint = self.world_from_cam.inverse().adjoint()
        return adjoint @ self.covariance @ adjoint.T

    def to_json(self, query: str) -> dict[str, Any]:
        """Return one line of the result file, see docs/cli.md."""
        return {
            "query": query,
            "localized": True,
            "world_from_cam": pose_to_json(self.world_from_cam),
            "covariance": self.covariance.tolist(),
            "position_sigma_m": self.position_sigma_m,
            "rotation_sigma_deg": self.rotation_sigma_deg,
            "probability": self.probability,
            **({} if self.calibrated else {"calibrated": False}),
            "node": self.node_id,
            **_evidence_json(self),
            **({} if self.focal_length_px is None else {"focal_length_px": self.focal_length_px}),
            **({} if self.noise_share == 1.0 else {"noise_share": self.noise_share}),
            **({} if self.evidence is None else {"evidence": asdict(self.evidence)}),
            **(
                {}
                if self.calibration_doubt is None
                else {"calibration_doubt": self.calibration_doubt.to_json()}
            ),
            **({} if self.geopose is None else {"geopose": self.geopose.to_json()}),
        }

    @staticmethod
    def from_json(line: str | bytes | Mapping[str, Any]) -> Localization:
        """Parse the output of `to_json`, as text or as an object.

        The query name and `seen_camera` are not restored.

        Raises:
            ResultError: it is not a result, or the result of an image that was not localized.
        """
        data = checked.parse_object(line)
        if checked.require(data, "localized") is not True:
            raise ResultError(
                "the result of an image that was not localized holds no pose"
                " (NotLocalized.from_json reads it)"
            )
        focal, evidence, doubt = (
            data.get(key) for key in ("focal_length_px", "evidence", "calibration_doubt")
        )
        return Localization(
            checked.pose_from_json(checked.require(data, "world_from_cam"), "world_from_cam"),
            checked.covariance(checked.require(data, "covariance"), "covariance"),
            checked.number(checked.require(data, "probability"), "probability", 0.0, 1.0),
            checked.integer(checked.require(data, "node"), "node"),
            **_parse_evidence_fields(data),
            evidence=None if evidence is None else _parse_evidence(evidence),
            focal_length_px=(
                None if focal is None else checked.number(focal, "focal_length_px", 0.0)
            ),
            noise_share=checked.number(data.get("noise_share", 1.0), "noise_share", 0.0, 1.0),
            calibrated=data.get("calibrated", True) is not False,
            provenance=Provenance.from_json(data),
            geopose=_parse_geopose(data),
            calibration_doubt=None if doubt is None else _parse_calibration_doubt(doubt),
        )


@dataclass(frozen=True, eq=False)
class Alternative:
    """Hold one possible pose of an ambiguous image and its probability.

    The probabilities of all alternatives sum to less than 1. The rest is the probability of none of
    them. `geopose` is as in `Localization`. `tile` is the atlas tile in whose world the pose is.
    """

    world_from_cam: Rigid3
    probability: float
    node_id: int
    geopose: GeoPose | None = None
    tile: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the alternative as a JSON object."""
        pose = {
            "world_from_cam": pose_to_json(self.world_from_cam),
            "probability": self.probability,
            "node": self.node_id,
        }
        pose |= {} if self.tile is None else {"tile": self.tile}
        return pose if self.geopose is None else pose | {"geopose": self.geopose.to_json()}

    @staticmethod
    def from_json(data: Any) -> Alternative:
        """Parse the output of `to_json`.

        Raises:
            ResultError: it is not an alternative.
        """
        if not isinstance(data, Mapping):
            raise ResultError("no result: an alternative is an object")
        return Alternative(
            checked.pose_from_json(checked.require(data, "world_from_cam"), "world_from_cam"),
            checked.number(checked.require(data, "probability"), "probability", 0.0, 1.0),
            checked.integer(checked.require(data, "node"), "node"),
            _parse_geopose(data),
            None if data.get("tile") is None else checked.text(data["tile"], "tile"),
        )


@dataclass(frozen=True, eq=False)
class NotLocalized:
    """Report that no pose is certain enough, with the `reason`.

    `alternatives` holds the possible poses of an `ambiguous` image, likeliest first.
    """

    reason: Reason
    candidates: list[NodeScore] = field(default_factory=list)
    num_matches: int = 0
    num_inliers: int = 0
    times_ms: dict[str, float] = field(default_factory=dict)
    detail: str = ""
    alternatives: tuple[Alternative, ...] = ()
    provenance: Provenance = EMPTY_PROVENANCE
    seen_camera: IntrinsicsDeviation | None = None

    @property
    def localized(self) -> Literal[False]:
        """Return False."""
        return False

    def to_json(self, query: str) -> dict[str, Any]:
        """Return one line of the result file, see docs/cli.md."""
        alternatives = [one.to_json() for one in self.alternatives]
        refusal = {
            "query": query,
            "localized": False,
            "reason": self.reason,
            "detail": self.detail,
            "alternatives": alternatives,
        }
        return refusal | _evidence_json(self)

    @staticmethod
    def from_json(line: str | bytes | Mapping[str, Any]) -> NotLocalized:
        """Parse the output of `to_json`, as text or as an object. The query name is not restored.

        Raises:
            ResultError: it is not a result, or the result of an image that was localized.
        """
        data = checked.parse_object(line)
        if checked.require(data, "localized") is not False:
            raise ResultError(
                "the result of an image that was localized is no refusal (Localization.from_json"
                " reads it)"
            )
        reason = checked.require(data, "reason")
        if reason not in get_args(Reason):
            raise ResultError(f"no result: the reason is none of {', '.join(get_args(Reason))}")
        return NotLocalized(
            reason,
            **_parse_evidence_fields(data),
            detail=checked.text(data.get("detail", ""), "detail"),
            alternatives=tuple(
                Alternative.from_json(one)
                for one in checked.items(data.get("alternatives", []), "alternatives")
            ),
            provenance=Provenance.from_json(data),
        )


R = TypeVar("R", bound=Localization | NotLocalized)


def result_from_json(line: str | bytes | Mapping[str, Any]) -> Localization | NotLocalized:
    """Parse a result of either class.

    Raises:
        ResultError: it is not a result.
    """
    data = checked.parse_object(line)
    return (
        Localization.from_json(data)
        if data.get("localized") is True
        else NotLocalized.from_json(data)
    )


def with_time(result: R, t_ns: int) -> R:
    """Return the result with the capture time of its image, nanoseconds."""
    return replace(result, provenance=replace(result.provenance, t_ns=t_ns))


def _evidence_json(result: Localization | NotLocalized) -> dict[str, Any]:
    return {
        "candidates": [[c.node_id, round(c.score, 4)] for c in result.candidates],
        "num_matches": result.num_matches,
        "num_inliers": result.num_inliers,
        "times_ms": {stage: round(ms, 3) for stage, ms in result.times_ms.items()},
        **result.provenance.to_json(),
    }


def _parse_geopose(data: Mapping[str, Any]) -> GeoPose | None:
    try:
        return None if data.get("geopose") is None else GeoPose.from_json(data["geopose"])
    except GeoreferenceError as error:
        raise ResultError(f"no result: 'geopose': {error}") from None


def _parse_evidence(value: Any) -> Evidence:
    data = checked.mapping(value, "evidence")
    values: dict[str, Any] = {}
    for one in fields(Evidence):
        is_missing = one.name in ("num_distinct", "num_lesser_side") and data.get(one.name) is None
        read = checked.integer if one.name.startswith("num_") else checked.number
        values[one.name] = (
            None if is_missing else read(checked.require(data, one.name), f"evidence.{one.name}")
        )
    return Evidence(**values)


def _parse_calibration_doubt(value: Any) -> CalibrationMismatch:
    data = checked.mapping(value, "calibration_doubt")

    def vector(key: str, length: int) -> np.ndarray:
        values = [
            checked.number(one, key) for one in checked.items(checked.require(data, key), key)
        ]
        if len(values) != length:
            raise ResultError(f"no result: {key!r} is no {length} numbers")
        return np.array(values)

    of = checked.items(checked.require(data, "of"), "of")
    focal, sigma, calibrated = (
        checked.number(checked.require(data, key), key, 0.0) for key in MISMATCH_FOCAL_FIELDS
    )
    return CalibrationMismatch(
        focal,
        sigma,
        calibrated,
        vector("principal_point_px", 2),
        vector("calibrated_principal_point_px", 2),
        "focal_length" in of,
        "principal_point" in of,
        vector("shift", 6),
    )


def _parse_evidence_fields(data: Mapping[str, Any]) -> dict[str, Any]:
    pairs = [
        checked.items(pair, "candidates")
        for pair in checked.items(checked.require(data, "candidates"), "candidates")
    ]
    if any(len(pair) != 2 for pair in pairs):
        raise ResultError("no result: 'candidates' are pairs of a node and its score")
    times_ms = checked.require(data, "times_ms")
    if not isinstance(times_ms, Mapping):
        raise ResultError("no result: 'times_ms' are milliseconds by the names of stages")
    return {
        "candidates": [
            NodeScore(checked.integer(node_id, "candidates"), checked.number(score, "candidates"))
            for node_id, score in pairs
        ],
        "num_matches": checked.integer(checked.require(data, "num_matches"), "num_matches"),
        "num_inliers": checked.integer(checked.require(data, "num_inliers"), "num_inliers"),
        "times_ms": {str(stage): checked.number(ms, "times_ms") for stage, ms in times_ms.items()},
    }
