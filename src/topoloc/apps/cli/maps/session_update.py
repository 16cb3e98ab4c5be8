"""Add recordings to a map file, or to the matching tiles of an atlas, here or on a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from topoloc import (
    Atlas,
    AtlasConfig,
    DuplicateSessionError,
    LocalizerConfig,
    StereoSequence,
    Tile,
    find_tile_of_recording,
    run_slam,
    update,
    with_pose_conventions,
    with_trajectory,
)
from topoloc.apps.cli.features_option import open_localizer
from topoloc.apps.cli.mapping.map_jobs import parse_conventions
from topoloc.apps.cli.mapping.recordings_table import print_notes, recordings_table
from topoloc.apps.cli.output import UsageError, interruptible, open_recording, print_waiting
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.connection import connect_to_cluster
from topoloc.apps.cluster.remote import Progress
from topoloc.apps.cluster.tasks import Job, JobProgress, OnJobState, run_locally, run_on_ray
from topoloc.apps.cluster.tiles import Outcome, State, run_tile_work


@dataclass(frozen=True)
class SessionUpdateOptions:
    """The options of `topoloc update` for one recording. They can be sent to another machine."""

    recording: str
    localize: LocalizerConfig
    trajectory: str | None = None
    poses: str | None = None
    format: str | None = None
    camera: str | None = None
    topics: str | None = None
    light: str | None = None
    mask: str | None = None

    def open_session(self) -> OpenSessionUpdate:
        """Open the recording and print its notes to standard error. Raises RecordingError."""
        words = self.recording, self.format, self.camera, self.topics
        return OpenSessionUpdate(self, open_recording(*words, whole_only=True, mask=self.mask))


class OpenSessionUpdate:
    """An open recording. It joins one map, or again a newer version of the map that another process
    wrote meanwhile."""

    def __init__(self, options: SessionUpdateOptions, sequence: StereoSequence) -> None:
        self.options, self.sequence = options, sequence
        self._posed_sequence: StereoSequence | None = None

    def join(self, path: Path, progress: Progress) -> tuple[StereoSequence, dict[str, Any]]:
        """Add the session to the map file. Return it with its poses, and the changes. Raises
        UsageError: the options contradict each other; TopolocError: as of `update` and
        `run_slam`."""
        one = self.options

        def find_poses(poses_from: str) -> StereoSequence:
            if self._posed_sequence is None:
                self._posed_sequence = self._with_poses(poses_from, progress)
            return self._posed_sequence

        is_checked = parse_conventions(one.poses)[1]
        how = (one.trajectory, find_poses, one.localize, one.light, is_checked)
        done = update(path, self.sequence, *how, progress, print_waiting)
        return done.sequence, done.changes

    def _with_poses(self, poses_from: str, progress: Progress) -> StereoSequence:
        """Return the recording with its own poses."""
        if poses_from in ("slam", "map") and self.options.poses is not None:
            raise UsageError(
                "--poses is the convention of given poses; omit it for those of SLAM and of the map"
            )
        if poses_from == "map":
            return self.sequence
        if poses_from == "slam":
            return run_slam([self.sequence], progress).apply([self.sequence])[0]
        reading = parse_conventions(self.options.poses)[0]
        if poses_from == "truth":
            return with_pose_conventions(self.sequence, reading)
        return with_trajectory(self.sequence, Path(poses_from), reading)


@dataclass(frozen=True)
class TileSelectionJob:
    """A job that finds the tile of a recording. Its outcome names the tile."""

    options: SessionUpdateOptions
    atlas: str
    atlas_config: AtlasConfig

    @property
    def name(self) -> str:
        return f"which tile {self.options.recording}"

    def run(self, progress: Progress) -> Outcome:
        def find_tile() -> tuple[State, Tile]:
            with interruptible():
                sequence, atlas = self.options.open_session().sequence, Atlas.open(self.atlas)
                localizer = open_localizer(atlas, self.options.localize, None, self.atlas_config)
                return "recognised", find_tile_of_recording(atlas, localizer, sequence, progress)

        return run_tile_work(self.options.recording, "", find_tile)

    def failure_outcome(self, reason: str) -> Outcome:
        return Outcome(self.options.recording, "", "failed", reason)


@dataclass(frozen=True)
class TileSessionJob:
    """A job that adds a recording to a tile, unless the tile contains it."""

    options: SessionUpdateOptions
    atlas: str
    tile_id: str

    @property
    def name(self) -> str:
        return f"update {self.tile_id} {self.options.recording}"

    def run(self, progress: Progress) -> Outcome:
        changes = dict[str, Any]()

        def update_tile() -> tuple[State, Tile]:
            session, state = self.options.open_session(), "there"
            with suppress(DuplicateSessionError), interruptible():
                atlas = Atlas.open(self.atlas)
                _, done = atlas.edit(self.tile_id, lambda path: session.join(path, progress))
                changes.update(done)
                state = "updated"
            return state, Atlas.open(self.atlas).tile(self.tile_id)

        outcome = run_tile_work(self.options.recording, self.tile_id, update_tile)
        return replace(outcome, changes=changes or None)

    def failure_outcome(self, reason: str) -> Outcome:
        return Outcome(self.options.recording, self.tile_id, "failed", reason)


@dataclass(frozen=True)
class AtlasUpdate:
    """Add each recording to its tile, or all of them to the tile `tile_id`, on the cluster `ray` if
    it is given. All tiles are found before the first recording joins."""

    update_options: Sequence[SessionUpdateOptions]
    atlas: Atlas
    tile_id: str | None
    ray: str | None
    atlas_config: AtlasConfig
    cluster: ClusterConfig

    def outcomes(self) -> list[Outcome]:
        """Return the outcome of each recording, and print them as they finish. Raises AtlasError:
        the atlas has no tile `tile_id`; MissingExtraError, ClusterError: from
        `connect_to_cluster`."""
        where = self.atlas.address
        tile = None if self.tile_id is None else self.atlas.tile(self.tile_id)
        names = [options.recording for options in self.update_options]
        with (
            nullcontext() if self.ray is None else connect_to_cluster(self.ray),
            recordings_table(names) as (show, is_live),
        ):
            chosen = (
                [Outcome(name, tile.tile_id, "recognised") for name in names]
                if tile
                else self._select_tiles(where, show, is_live)
            )
            known = [number for number, one in enumerate(chosen) if one.state == "recognised"]
            jobs = [
                TileSessionJob(self.update_options[number], where, chosen[number].tile_id)
                for number in known
            ]
            joined = self._run(
                jobs, lambda k, state: show(known[k], state), is_live, [job.tile_id for job in jobs]
            )
        for number, outcome in zip(known, joined, strict=True):
            chosen[number] = replace(
                outcome, notes=tuple(dict.fromkeys(chosen[number].notes + outcome.notes))
            )
        print_notes(chosen, is_live)
        return chosen

    def _select_tiles(self, where: str, show: OnJobState[Outcome], is_live: bool) -> list[Outcome]:
        """Return the tile of each recording. The outcome is failed if there is none."""

        def show_failures(number: int, state: Outcome | JobProgress) -> None:
            if is_live or (isinstance(state, Outcome) and state.reason is not None):
                show(number, state)

        return self._run(
            [TileSelectionJob(one, where, self.atlas_config) for one in self.update_options],
            show_failures,
            is_live,
        )

    def _run(
        self,
        jobs: Sequence[Job[Outcome]],
        show: OnJobState[Outcome],
        is_live: bool,
        lines: Sequence[str] | None = None,
    ) -> list[Outcome]:
        if self.ray is None or not jobs:
            return run_locally(jobs, show, is_live)
        return run_on_ray(jobs, self.ray, self.cluster, show, is_live, lines)


def describe_update(changes: dict[str, Any]) -> str:
    """Return the changes of a session as one line."""
    c, total, posed = changes, changes["frames"], changes["frames_with_pose"]
    seen = f"{c['recording']} joins as session {c['session']}: {posed} of {total} frames"
    if c["poses_from"] == "map":
        carried = c["frames_by_odometry"]
        by = f"{posed - carried} by the map, {carried} by odometry"
        seen = f"{seen} ({by}, {total - posed} without a pose)"
    localized = f"{c['localized']} of {c['asked']} images were localized"
    size = f"{c['bytes_before'] / 1e6:.2f} to {c['bytes'] / 1e6:.2f} MB"
    added = f"{c['nodes_added']} nodes added"
    more = f"{describe_learning(changes)}{describe_outdated_models(changes)}"
    return f"{seen}, {localized}, {added}, {size}{more}"


def describe_learning(changes: dict[str, Any]) -> str:
    """Return what the map learned of images that it recognises poorly, if there are any."""
    c, why, remedy = changes, "its poses do not agree with the map", "give better ones, or none"
    if (of_others := c.get("landmarks_of_each_other_seen")) is not None:
        of_map, remedy = c["landmarks_of_map_seen"], "record more images there in this light"
        why = f"they show {of_others} landmarks of each other, {of_map} of the map before"
    if c.get("learned"):
        room = f"{c.get('landmarks_dropped', 0)} landmarks that are seen least made room"
        return f"; it learned the light of {c['learned']} images: {why}; {room}"
    poor = f"; {c.get('poorly_recognised')} poorly recognised images taught it nothing"
    return f"{poor}: {why}; {remedy}" if c.get("poorly_recognised") else ""


def describe_outdated_models(changes: dict[str, Any]) -> str:
    """Return the coarse localizers that do not rank new nodes, each with a remedy."""
    if not changes["not_taught"] or not changes["nodes_added"]:
        return ""
    remedies = {"cnn-fc": "`topoloc train --coarse cnn-fc --weights map` teaches it"}
    return "".join(
        f"; {name} knows nothing of them: {remedies.get(name, 'PyTorch is missing here')}"
        for name in changes["not_taught"]
    )
