"""A recording without poses: SLAM finds them, and the map is built on what it found.

    python examples/slam_trajectory.py [SEQ] [--out FILE.tum]

SEQ is a stereo or RGB-D recording; by default one lap of the built-in lab, whose true poses only
judge the result. `topoloc slam SEQ FILE.tum` and `topoloc build SEQ MAP --trajectory slam` do the
same.
"""

import argparse
from pathlib import Path

import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.alignment import absolute_trajectory_errors
from topoloc.recordings.trajectory import Trajectory, with_trajectory
from topoloc.slam.slam import run_slam


def main(recording: str, out: Path) -> None:
    sequence = topoloc.open_sequence(recording)
    result = run_slam(sequence)
    (poses,) = result.poses  # one list for each recording
    known = [i for i, pose in enumerate(poses) if pose is not None]
    print(
        f"{len(known)} of {len(poses)} frames tracked, {result.num_keyframes} key frames,"
        f" {result.num_loops} loops closed"
    )

    # The world of these poses is the camera of the first frame; `evo_traj tum FILE.tum --plot`
    # draws them.
    Trajectory(
        [pose for pose in poses if pose is not None], [sequence.t_ns[i] for i in known]
    ).write_tum(out)
    truth = [(sequence.poses[i], poses[i]) for i in known if sequence.poses[i] is not None]
    if truth:
        errors = absolute_trajectory_errors(
            [true for true, _ in truth], [pose for _, pose in truth]
        )
        print(
            f"absolute trajectory error {100.0 * np.sqrt(np.mean(errors**2)):.2f} cm over"
            f" {len(truth)} frames"
        )

    topomap = topoloc.build_map(with_trajectory(sequence, out))
    frame = sequence[0]
    answer = topoloc.Localizer(topomap).localize(frame.image, frame.camera)
    where = (
        np.round(answer.world_from_cam.translation, 3)
        if isinstance(answer, topoloc.Localization)
        else answer.reason
    )
    print(
        f"map of {len(topomap.nodes)} nodes; its first frame is the origin of the world, and is"
        f" found at {where} m"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "recording",
        nargs="?",
        default=str(SHIPPED / "map_lap1"),
        help="a stereo or RGB-D recording",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("lap.tum"), help="the trajectory, TUM format"
    )
    args = parser.parse_args()
    main(args.recording, args.out)
