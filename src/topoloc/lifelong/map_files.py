"""Edits of map files: a recording joins a map, two maps become one, a map shrinks to a size.

Each edit replaces the file as a whole and is an entry of the map's history. `undo_edit` restores
the file before it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from topoloc.lifelong.merge import merge_maps
from topoloc.lifelong.prune import prune_map
from topoloc.lifelong.update import MapUpdate, check_session_is_new, update_map
from topoloc.localization.config import LocalizerConfig
from topoloc.mapping.build import Progress
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.sessions import Edit, today
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.slam.pose_checks import check_poses
from topoloc.slam.slam import estimate_slam_poses


@dataclass(frozen=True, eq=False)
class PrunedFile:
    """The changes of a pruned map file, numbers by their names, and its mapped length (m)."""

    changes: dict[str, Any]
    length_m: float


def default_pose_source(sequence: StereoSequence) -> str:
    """Return the default source of a new session's poses: `truth` if the recording has poses,
    `slam` for stereo or RGB-D, `map` for a single camera. Raises UnreadableImageError."""
    is_single = (first := sequence[0]).right is None and first.depth is None
    return "truth" if any(sequence.poses) else "map" if is_single else "slam"


def update(
    path: str | Path,
    sequence: StereoSequence | str | Path,
    poses_from: str | None = None,
    find_poses: Callable[[str], StereoSequence] | None = None,
    localizer_config: LocalizerConfig | None = None,
    light: str | None = None,
    is_checked: bool = True,
    progress: Progress | None = None,
    on_wait: WaitCallback | None = None,
) -> MapUpdate:
    """Add a recording to a map file as a new session.

    Args:
        path: the map file, which is replaced.
        sequence: the recording, or its path: stereo, RGB-D or a single camera.
        poses_from: the source of its poses, stored in the map: `truth` (its own poses, metres, in
            any world), `slam`, `map` (localized in the map, image by image), or a name for given
            poses. By default as `default_pose_source`.
        find_poses: returns the recording with its poses from this source; called only if the
            session is new. By default SLAM runs if `poses_from` is `slam`.
        light: the name of the recording's illumination; by default it has none.
        is_checked: whether given poses are compared with the images first.
        progress: called with a stage's name, steps done and steps in all.
        on_wait: called if another process edits the map, before this one waits.

    Returns:
        The updated map and the changes; these contain the file's bytes before and after.

    Raises:
        ConfigError: a setting is out of its bounds.
        DuplicateSessionError: the map contains the session already.
        TrajectoryError: the poses do not fit the images, or too few images are localized.
        MapError: the map is missing, damaged, or cannot be written.
        RecordingError, CalibrationError, UnreadableImageError: from reading the recording.
    """
    if isinstance(sequence, str | Path):
        sequence = open_sequence(sequence)
    poses_from = poses_from or default_pose_source(sequence)
    with edit_map(path, on_wait) as edit:
        check_session_is_new(edit.topomap, sequence)  # before its poses are estimated
        if find_poses is not None:
            posed = find_poses(poses_from)
        elif poses_from == "slam":
            posed = estimate_slam_poses([sequence], progress=progress)[0]
        else:
            posed = sequence
        if is_checked and poses_from not in ("map", "slam"):
            check_poses(posed)
        updated = update_map(edit.topomap, posed, poses_from, localizer_config, progress)
        changes = updated.changes | {"bytes_before": edit.path.stat().st_size}
        topomap = updated.topomap
        if light is not None:
            *others, last = topomap.sessions
            topomap = replace(topomap, sessions=[*others, replace(last, light_name=light)])
        edit.commit(topomap, f"update {sequence.name}", changes)
    return replace(updated, changes=changes | {"bytes": Path(path).stat().st_size})


def prune(
    path: str | Path,
    max_mb: float | None = None,
    descriptors: Literal["fine", "coarse"] = "fine",
    on_wait: WaitCallback | None = None,
) -> PrunedFile:
    """Remove from a map file the landmarks that are gone and, with a budget, those that add least.

    Args:
        path: the map file, which is replaced if anything is removed.
        max_mb: megabytes that the file may have; None removes only landmarks that are gone.
        descriptors: as of `prune_map`.
        on_wait: called if another process edits the map, before this one waits.

    Raises:
        ConfigError: a setting is out of its bounds.
        MapError: the budget is too small, or the map is missing, damaged, or cannot be written.
    """
    with edit_map(path, on_wait) as edit:
        before, length_m = edit.path.stat().st_size, edit.topomap.length_m
        max_bytes = None if max_mb is None else round(max_mb * 1e6)
        pruned = prune_map(edit.topomap, edit.path, max_bytes, descriptors)
        changes = pruned.changes | {"bytes_before": before}
        if pruned.topomap is not edit.topomap:
            to_size = "" if max_mb is None else f" to {max_mb:g} MB"
            how = ", descriptors coarse" if descriptors == "coarse" else ""
            edit.commit(pruned.topomap, f"prune{to_size}{how}", changes)
    return PrunedFile(changes | {"bytes": Path(path).stat().st_size}, length_m)


def merge(
    first: str | Path,
    second: str | Path,
    out: str | Path,
    localizer_config: LocalizerConfig | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Merge two map files of overlapping places into a new one, in the world of the first.

    Returns:
        The changes: numbers and texts by their names, with the bytes of the new file.

    Raises:
        ConfigError: a setting is out of its bounds.
        MapError: a map is missing or damaged, both are one map, the second lacks a feature type of
            the first, or the new file cannot be written.
        TrajectoryError: the maps have too little in common.
        FeatureTypeError, MissingExtraError, WeightsError: their features are not available here.
    """
    with TopoMetricMap.load(first) as one, TopoMetricMap.load(second) as other:
        merged = merge_maps(one, other, localizer_config, progress)
        edit = Edit(
            one.free_ids.edit,
            f"merge {Path(second).name}",
            today(),
            SCHEMA_VERSION,
            merged.changes,
        )
        replace(merged.topomap, edits=[*one.edits, edit]).save(out)
    return merged.changes | {"bytes": Path(out).stat().st_size}
