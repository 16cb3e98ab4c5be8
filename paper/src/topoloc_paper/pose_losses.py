"""Compute the error of a regressed pose by PoseNet's losses.

Poses are pairs of translations (n, 3), metres, and unit quaternions (n, 4), w first, of
world_from_cam. A quaternion and its negative are one rotation.
"""

from __future__ import annotations

import torch
from torch import Tensor

Poses = tuple[Tensor, Tensor]
# Points nearer than this to either camera's plane say nothing about the pose; errors beyond the
# other count no more.
_MIN_DEPTH, _MAX_ERROR = 0.1, 2.0


def beta_loss(found: Poses, truth: Poses, beta: float) -> Tensor:
    """|t - t'| + beta |q - q'| (Kendall et al. 2015, Eq. 2)."""
    return (found[0] - truth[0]).norm(dim=1).mean() + beta * _quaternion_errors(
        found[1], truth[1], norm=2
    ).mean()


def learnt_loss(found: Poses, truth: Poses, log_variances: Tensor) -> Tensor:
    """Both errors weighed by variances that are learnt with the network (Kendall & Cipolla 2017,
    Eq. 5)."""
    errors = torch.stack(
        [
            (found[0] - truth[0]).abs().sum(dim=1).mean(),
            _quaternion_errors(found[1], truth[1], norm=1).mean(),
        ]
    )
    return (errors * torch.exp(-log_variances) + log_variances).sum()


def reprojection_loss(found: Poses, truth: Poses, points_world: Tensor) -> Tensor:
    """How far points (n, k, 3) that the true camera sees move in the picture, in focal lengths
    (Kendall & Cipolla 2017, Eq. 7)."""
    seen, true = _in_camera(found, points_world), _in_camera(truth, points_world)
    in_front = (true[..., 2] > _MIN_DEPTH).float()
    moved = (_projected(seen) - _projected(true)).abs().sum(dim=-1).clamp(max=_MAX_ERROR)
    # Where points lie behind the regressed camera the picture has no gradient: there the distance
    # of the points leads back.
    lost = (seen[..., 2] <= _MIN_DEPTH).float()
    apart = (seen - true).abs().sum(dim=-1)
    return ((moved * (1.0 - lost) + apart * lost) * in_front).sum() / in_front.sum().clamp(min=1.0)


def _quaternion_errors(found: Tensor, truth: Tensor, norm: int) -> Tensor:
    return torch.minimum((found - truth).norm(p=norm, dim=1), (found + truth).norm(p=norm, dim=1))


def _in_camera(world_from_cam: Poses, points_world: Tensor) -> Tensor:
    translation, quat_wxyz = world_from_cam
    away = points_world - translation[:, None]
    w, axis = (
        quat_wxyz[:, None, :1],
        -quat_wxyz[:, None, 1:].expand_as(away),
    )  # the inverse rotation
    twist = 2.0 * torch.linalg.cross(axis, away)
    return away + w * twist + torch.linalg.cross(axis, twist)


def _projected(points_cam: Tensor) -> Tensor:
    return points_cam[..., :2] / points_cam[..., 2:].clamp(min=_MIN_DEPTH)
