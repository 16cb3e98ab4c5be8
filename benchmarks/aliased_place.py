"""Measure an aliased place, a wall of equal panels, with single images and with a stream, beside
the requirements.

    python benchmarks/aliased_place.py MAP_SEQ QUERY_SEQ [--seed N] [--json FILE]

Recordings show the world `hospital` of one seed, as by `topoloc simulate hospital hospital_map
--spacing 0.3` and `topoloc simulate hospital hospital_ask --spacing 0.45 --lateral 0.15 --take 1
--mono`. With `--look -80` in both, the camera sees little but the wall. A pose is right within 0.25
m and 5 degrees. It is a panel off if it is wrong along the corridor by whole metres to within a
quarter. An image is ambiguous if, by the plan of the place, every column of it shows panels,
without a door or a corner. It should be refused as ambiguous, with a right pose among its
alternatives. Then the same images are one stream, whose poses count from the first right one on.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular
from topoloc.tracking.tracker import Tracker
from topoloc_worlds.hospital.plan import BAY, walls_of

MAX_METRES, MAX_DEGREES = 0.25, 5.0


@dataclass(frozen=True)
class Alone:
    """Hold the results of single images by category."""

    pictures: int
    right: int
    wrong: int
    one_panel_off: int
    ambiguous: int
    ambiguous_with_truth: int
    refused: dict[str, int]
    alike: int
    """Those that cannot be told apart; and what became of them."""
    alike_with_truth: int
    alike_kinds: dict[str, int]


@dataclass(frozen=True)
class Streamed:
    """A stream's frames from its first right pose on."""

    frames: int
    right: int
    wrong: int
    one_panel_off: int
    first_right: int | None
    states: dict[str, int]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mapped")
    parser.add_argument("asked")
    parser.add_argument("--seed", type=int, default=0, help="the hospital's")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    localizer = Localizer(build_map(open_sequence(args.mapped)))
    sequence = as_monocular(open_sequence(args.asked))
    frames = [
        frame
        for frame in (sequence[i] for i in range(len(sequence)))
        if frame.world_from_cam is not None
    ]
    alone, streamed = asked_alone(localizer, frames, args.seed), asked_as_stream(localizer, frames)
    report(len(localizer.topomap.nodes), alone, streamed)
    if args.json:
        figures = {
            "nodes": len(localizer.topomap.nodes),
            "alone": asdict(alone),
            "stream": asdict(streamed),
        }
        args.json.write_text(json.dumps(figures, indent=1))


def asked_alone(localizer: Localizer, frames: list[StereoFrame], seed: int) -> Alone:
    kinds: Counter[str] = Counter()
    alike_kinds: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    for frame in frames:
        assert frame.world_from_cam is not None
        result = localizer.localize(frame.image, frame.camera)
        if isinstance(result, Localization):
            kind = verdict(result.world_from_cam, frame.world_from_cam)
        else:
            refused[result.reason] += 1
            with_truth = any(is_right(pose, frame.world_from_cam) for pose in alternatives(result))
            kind = (
                "ambiguous with truth"
                if result.reason == "ambiguous" and with_truth
                else result.reason
            )
        kinds[kind] += 1
        if shows_panels_only(frame, seed):
            alike_kinds[kind] += 1
    return Alone(
        pictures=len(frames),
        right=kinds["right"],
        wrong=kinds["panel off"] + kinds["wrong"],
        one_panel_off=kinds["panel off"],
        ambiguous=refused["ambiguous"],
        ambiguous_with_truth=kinds["ambiguous with truth"],
        refused=dict(refused),
        alike=alike_kinds.total(),
        alike_with_truth=alike_kinds["ambiguous with truth"],
        alike_kinds=dict(alike_kinds),
    )


def asked_as_stream(localizer: Localizer, frames: list[StereoFrame]) -> Streamed:
    tracker = Tracker(localizer)
    states: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    first_right = None
    for number, frame in enumerate(frames):
        assert frame.world_from_cam is not None
        assert frame.camera is not None
        answer = tracker.process(frame.image, frame.camera, frame.t_ns)
        kind = "none"
        if answer.smoothed is not None and answer.state in ("localized", "tracked"):
            kind = verdict(answer.smoothed, frame.world_from_cam)
        if first_right is None and kind == "right":
            first_right = number
        if first_right is not None:
            states[answer.state] += 1
            kinds[kind] += 1
    return Streamed(
        kinds.total(),
        kinds["right"],
        kinds["panel off"] + kinds["wrong"],
        kinds["panel off"],
        first_right,
        dict(states),
    )


def alternatives(result: NotLocalized) -> list[Rigid3]:
    """Return the alternative poses of an ambiguous image, empty if the localizer has none."""
    return [alternative.world_from_cam for alternative in getattr(result, "alternatives", ())]


def shows_panels_only(frame: StereoFrame, seed: int) -> bool:
    """Whether every column of the picture looks at panels: rays on the plan, at the height of the
    camera."""
    assert frame.camera is not None
    assert frame.world_from_cam is not None
    columns = np.column_stack(
        [np.linspace(0.0, frame.camera.width - 1.0, 65), np.full(65, frame.camera.cy)]
    )
    rays = (
        np.column_stack([frame.camera.normalized_from_img(columns), np.ones(65)])
        @ frame.world_from_cam.rotation.T
    )
    nearest, panelled = np.full(65, np.inf), np.zeros(65, np.bool_)
    for side in walls_of(seed).values():
        along = np.array([np.cos(side.wall.yaw), np.sin(side.wall.yaw)])
        to_wall = np.asarray(side.wall.start) - frame.world_from_cam.translation[:2]
        normal = np.array([-along[1], along[0]])
        with np.errstate(divide="ignore"):
            reach = to_wall @ normal / (rays[:, :2] @ normal)
        x = (reach[:, None] * rays[:, :2] - to_wall) @ along
        hit = (reach > 0.0) & (reach < nearest) & (x >= 0.0) & (x <= side.wall.length)
        nearest[hit] = reach[hit]
        panelled[hit] = np.any(
            [(x[hit] > left) & (x[hit] < left + BAY * bays) for left, bays in side.panelled()],
            axis=0,
        )
    return bool(panelled.all())


def verdict(world_from_cam: Rigid3, truth: Rigid3) -> str:
    """ "right", "panel off" or "wrong"."""
    if is_right(world_from_cam, truth):
        return "right"
    metres = translation_error(world_from_cam, truth)
    off = (
        round(metres / BAY) > 0
        and abs(metres - BAY * round(metres / BAY)) < BAY / 4
        and _degrees(world_from_cam, truth) < MAX_DEGREES
    )
    return "panel off" if off else "wrong"


def is_right(world_from_cam: Rigid3, truth: Rigid3) -> bool:
    return (
        translation_error(world_from_cam, truth) < MAX_METRES
        and _degrees(world_from_cam, truth) < MAX_DEGREES
    )


def _degrees(a: Rigid3, b: Rigid3) -> float:
    return float(np.rad2deg((a.inverse() @ b).angle()))


def report(num_nodes: int, alone: Alone, streamed: Streamed) -> None:
    print(f"{num_nodes} nodes, {alone.pictures} pictures")
    print(
        f"alone: {alone.right} right, refused {alone.refused}, {alone.ambiguous_with_truth} of the"
        " ambiguous with the true pose"
    )
    print(f"{alone.alike} show panels only: {alone.alike_kinds}")
    share = f"{100 * alone.alike_with_truth / alone.alike:.0f} %" if alone.alike else "none"
    row("of those, ambiguous with the true pose among the alternatives", ">= 95 %", share)
    off = f"{alone.wrong} of {alone.pictures} ({100 * alone.wrong / max(alone.pictures, 1):.1f} %)"
    row("accepted and wrong", "<= 1 %", f"{off}, {alone.one_panel_off} of them whole panels")
    if streamed.first_right is None:
        row("stream", "", "nothing right was ever seen")
        return
    print(
        f"stream, from picture {streamed.first_right} on: {streamed.frames} frames,"
        f" {streamed.states}"
    )
    row("right", ">= 98 %", f"{100 * streamed.right / streamed.frames:.1f} %")
    row(
        "wrong without saying",
        "0",
        f"{streamed.wrong}, {streamed.one_panel_off} of them whole panels",
    )


def row(what: str, asked: str, measured: str) -> None:
    print(f"  {what:<66} {asked:>8}   {measured}")


if __name__ == "__main__":
    main()
