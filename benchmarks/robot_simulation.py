"""A robot that drives in messages alone, and `topoloc follow --ros` beside it in real time.

    python benchmarks/robot_simulation.py [--map MAP --recording REC] [--hz 10] [--shared ../shared]

Plays images with camera_info and TF (odometry that drifts, a camera on a mount) over DDS. Without
arguments it plays the rendered room of the tests, the kitchen of 7-Scenes (one frame in four
mapped), and the demo's lab, rendered anew with an image each six centimetres (topoloc-worlds). A
recording must have truth in the world of the map. Each is played twice: plainly, and with images of
another place, darkness and a kidnapping.

Errors are those of the camera along map, odom, base and camera in TF, as tf2 interpolates it, fifty
times a second. Latency is from the stamp of an image to the arrival of its pose in this process.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.localization.map_facts.map_building import build_map
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular

TESTS = Path(__file__).parents[1] / "tests"
sys.path.insert(0, str(TESTS))
from played_robot import PlayedRobot, Step, followed  # noqa: E402

DEMO = Path(__file__).parents[1] / "src" / "topoloc" / "demo" / "lab"
DOMAIN, START_S = 100 + os.getpid() % 100, 150.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    )
    parser.add_argument("--map", type=Path)
    parser.add_argument("--recording")
    parser.add_argument("--hz", type=float, default=10.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        places = places_of(args, Path(folder))
        for name, topomap, camera, steps in places:
            print(f"{name}: {len(steps)} images at {args.hz:g} Hz", flush=True)
            for title, drive, kidnapped in (
                ("plain", steps, None),
                ("trouble", *with_trouble(steps)),
            ):
                report(title, topomap, camera, drive, kidnapped, args.hz)


def places_of(
    args: argparse.Namespace, folder: Path
) -> Iterator[tuple[str, Path, Camera, list[Step]]]:
    """Yield name, map, camera and steps of each place."""
    if args.map:
        yield args.recording, args.map, *steps_of(args.recording)
        return
    yield "room", *room(folder)
    kitchen = args.shared / "data" / "seven_scenes" / "kitchen" / "seq-01"
    if kitchen.is_dir():
        build_map([open_sequence(f"{kitchen}@0::4")]).save(folder / "kitchen.topo")
        yield "kitchen", folder / "kitchen.topo", *steps_of(f"{kitchen}@1-3/4")
    else:
        print(f"kitchen: no recording at {kitchen}")
    build_map([open_sequence(DEMO / "map_lap1"), open_sequence(DEMO / "map_lap2")]).save(
        folder / "lab.topo"
    )
    render = [sys.executable, "-m", "topoloc", "simulate", "lab", str(folder / "drive"), "--mono"]
    render += ["--jpeg", "90", "--spacing", "0.06", "--lateral", "0.08", "--take", "7"]
    done = subprocess.run([*render, "--num-frames", "120"], stdout=subprocess.DEVNULL)
    if done.returncode == 0:
        yield "lab", folder / "lab.topo", *steps_of(str(folder / "drive"))


def room(folder: Path) -> tuple[Path, Camera, list[Step]]:
    """Return map, camera and steps of the rendered room of the tests, there and back."""
    import tiny_world
    from built_room import built_room, recorded_room

    built_room(recorded_room(folder / "room")).save(folder / "room.topo")
    places, panels = np.arange(1.0, 12.0, 0.15), tiny_world.room()
    steps = list[Step]()
    for number, place in enumerate([*places, *places[::-1]]):
        pose = tiny_world.path_pose(place)
        steps.append(Step(pose, tiny_world.render(panels, pose, noise_seed=number)[0]))
    return folder / "room.topo", tiny_world.CAMERA, steps


def steps_of(recording: str) -> tuple[Camera, list[Step]]:
    """Return the camera of a recording, and its frames with truth."""
    sequence = as_monocular(open_sequence(recording))
    frames = [sequence[index] for index in range(len(sequence))]
    steps = [
        Step(frame.world_from_cam, frame.image)
        for frame in frames
        if frame.world_from_cam is not None
    ]
    camera = frames[0].camera
    if camera is None or not steps:
        raise SystemExit(f"{recording}: no calibration, or no truth")
    return camera, steps


def with_trouble(steps: list[Step]) -> tuple[list[Step], int]:
    """Return the drive with 0.8 s of images of another place, 1.5 s of darkness, and a kidnapping
    to the place that is farthest away; and the step of the kidnapping."""
    middle = len(steps) // 2
    far = farthest(steps, middle)
    drive = list(steps[:middle])
    for number in range(8):
        other = steps[(far + number) % len(steps)].picture
        drive[10 + number] = Step(drive[10 + number].world_from_cam, other)
    for number in range(min(30, middle - 20), min(45, middle - 5)):
        dark = np.zeros_like(drive[number].picture)
        drive[number] = Step(drive[number].world_from_cam, dark)
    after = steps[far : far + 60] if len(steps) - far >= 60 else steps[far - 60 : far][::-1]
    carried = Step(after[0].world_from_cam, after[0].picture, is_carried=True)
    return [*drive, carried, *after[1:]], middle


def farthest(steps: list[Step], number: int) -> int:
    here = steps[number].world_from_cam.translation
    ways = [np.linalg.norm(step.world_from_cam.translation - here) for step in steps]
    return int(np.argmax(ways))


def report(
    title: str, topomap: Path, camera: Camera, steps: list[Step], kidnapped: int | None, hz: float
) -> None:
    """Play a drive and print its figures."""
    robot = PlayedRobot(camera, DOMAIN, hz)
    with followed(topomap, DOMAIN, "--ros") as process:
        if not robot.wait_for_listener(START_S):
            raise SystemExit("topoloc follow did not start")
        started = robot.stand(steps[0], lambda: bool(robot.heard.poses), START_S)
        if not started:
            raise SystemExit(f"no pose at the start: {robot.heard.statuses[-1:]}")
        robot.heard.poses.clear()
        robot.play(steps)
        time.sleep(0.3)
        process.send_signal(signal.SIGTERM)
        status = process.wait(30)
    last = len(steps) - 2
    errors = robot.errors(0, last if kidnapped is None else kidnapped - 1)
    poses, latencies = robot.pose_errors(), 1e3 * robot.latencies()
    wrong, late = int((poses > 0.3).sum()), np.percentile(latencies, 95)
    lines = [
        f"TF: median {100 * np.median(errors):.2f} cm, largest {100 * errors.max():.1f} cm",
        f"{len(poses)} poses: median {100 * np.median(poses):.2f} cm, {wrong} off by more than"
        " 0.3 m",
        f"latency: median {np.median(latencies):.0f} ms, 95 % {late:.0f} ms",
        f"largest gap of map to odom {robot.gaps().max():.3f} s; exit status {status}",
    ]
    if kidnapped is None:
        drift = steps[0].world_from_cam @ robot.odometry[0].inverse() @ robot.odometry[-1]
        way = np.linalg.norm(drift.translation - steps[-1].world_from_cam.translation)
        lines.append(f"odometry alone would end {100 * way:.0f} cm off")
    else:
        after = robot.errors(kidnapped, last)
        wrong = np.flatnonzero(after > 0.1)
        lines.append(
            f"right again {(wrong[-1] + 1) / 50 if len(wrong) else 0:.1f} s after the kidnapping"
        )
    for line in lines:
        print(f"  {title:8} {line}", flush=True)
    robot.close()


if __name__ == "__main__":
    main()
