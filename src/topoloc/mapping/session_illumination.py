"""Group the sessions of a map by illumination, by user-given names or by measured values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from topoloc.mapping.sessions import Illumination, Session
from topoloc.mapping.storage.entries import NodeSummary


def compute_illumination_distance(a: Illumination, b: Illumination) -> float:
    """Return the distance between two illuminations: grey level, contrast, shares of dark and
    bright pixels, and colours with half the weight."""
    return float(np.linalg.norm(_to_vector(a) - _to_vector(b)))


def group_by_illumination(
    sessions: Sequence[Session], weights: Mapping[int, int]
) -> dict[int, int]:
    """Return the illumination group of each session by its id. Group 0 is the illumination of the
    session with the largest weight.

    Sessions are processed by decreasing weight (`weights` by id). Each joins the first group with
    similar illumination. If both have names, the names decide. A session without any information
    joins group 0.
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
    """Return the illumination group (`group_by_illumination`) of each node's session. It is 0 if
    the session is unknown."""
    ids, counts = np.unique([summary.session_id for summary in summaries], return_counts=True)
    groups = group_by_illumination(sessions, dict(zip(ids.tolist(), counts.tolist(), strict=True)))
    return np.array([groups.get(summary.session_id, 0) for summary in summaries], np.int64)


def _has_illumination(session: Session) -> bool:
    return session.light is not None or session.light_name is not None


def _is_same_illumination(a: Session, b: Session) -> bool:
    if a.light_name is not None and b.light_name is not None:
        return a.light_name == b.light_name
    # Sessions closer than this have the same illumination. Two walks of one path by day
    # differ by 0.02, two of a lab by 0.04, floors of a tower by up to 0.06. Day and night of
    # that path differ by 0.17.
    max_distance = 0.1
    return (
        a.light is not None
        and b.light is not None
        and compute_illumination_distance(a.light, b.light) < max_distance
    )


def _to_vector(light: Illumination) -> Float[np.ndarray, "6"]:
    return np.array(
        [light.level, light.contrast, light.dark, light.bright, 0.5 * light.red, 0.5 * light.blue]
    )
