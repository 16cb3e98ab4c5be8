"""Which sessions of a map were taken in one light: by the names that their users gave, else as
their pictures show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from topoloc.mapping.entries import NodeSummary
from topoloc.mapping.sessions import Illumination, Session

_MAX_SAME_DISTANCE = 0.1
"""Lights that differ by less are one. Two walks of one path by day differ by 0.02, two of a lab
0.04, floors of a tower up to 0.06; day and night of that path by 0.17."""


def compute_illumination_distance(a: Illumination, b: Illumination) -> float:
    """How far two lights are apart: grey levels, contrast, shares of dark and bright pixels, and,
    half as much, their colours."""
    return float(np.linalg.norm(_to_vector(a) - _to_vector(b)))


def group_by_illumination(
    sessions: Sequence[Session], weights: Mapping[int, int]
) -> dict[int, int]:
    """A number for the light of each session by its id; number 0 is the light of the session that
    weighs most.

    Sessions are taken in the order of their `weights` (by their ids), the heaviest first; each
    joins the first light that is like its own. Names decide where both have one; a session of which
    nothing is known counts for the light of number 0.
    """
    leaders, groups = list[Session](), dict[int, int]()
    for session in sorted(sessions, key=lambda one: -weights.get(one.session_id, 0)):
        group = next(
            (k for k, leader in enumerate(leaders) if _is_same_illumination(session, leader)), None
        )
        if group is None:
            group = len(leaders) if _has_illumination(session) or not leaders else 0
            if group == len(leaders):
                leaders.append(session)
        groups[session.session_id] = group
    return groups


def find_node_illumination_groups(
    summaries: Sequence[NodeSummary], sessions: Sequence[Session]
) -> Int[np.ndarray, " nodes"]:
    """The number of the light (`group_by_illumination`) in which each node's session was taken; 0
    where a session is unknown."""
    ids, counts = np.unique([summary.session_id for summary in summaries], return_counts=True)
    groups = group_by_illumination(sessions, dict(zip(ids.tolist(), counts.tolist(), strict=True)))
    return np.array([groups.get(summary.session_id, 0) for summary in summaries], np.int64)


def _has_illumination(session: Session) -> bool:
    return session.light is not None or session.light_name is not None


def _is_same_illumination(a: Session, b: Session) -> bool:
    if a.light_name is not None and b.light_name is not None:
        return a.light_name == b.light_name
    return (
        a.light is not None
        and b.light is not None
        and compute_illumination_distance(a.light, b.light) < _MAX_SAME_DISTANCE
    )


def _to_vector(light: Illumination) -> Float[np.ndarray, "6"]:
    return np.array(
        [light.level, light.contrast, light.dark, light.bright, 0.5 * light.red, 0.5 * light.blue]
    )
