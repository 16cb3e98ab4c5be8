from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import assert_same_pose, picture, pose
from topoloc.apps.formats.seven_scenes import COLOUR_FROM_DEPTH, open_seven_scenes
from topoloc.errors import RecordingError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence


def test_frames(seven_scenes: Path):
    sequence = open_seven_scenes(seven_scenes)
    assert sequence.name == "office/seq-01"
    assert sequence.names == ["frame-000000.color.png", "frame-000003.color.png"]
    assert sequence.t_ns == [0, 100_000_000]
    frame = sequence[1]
    np.testing.assert_array_equal(frame.image, picture(3, 3, 640, 480)[:, :, ::-1])
    assert frame.camera.params == (525.0, 525.0, 320.0, 240.0)
    assert frame.depth.camera.params == (585.0, 585.0, 320.0, 240.0)
    assert np.isnan(frame.depth.depth[0, :2]).all()
    assert frame.depth.depth[5, 5] == 1.5


def test_the_poses_are_the_depth_cameras(seven_scenes: Path):
    frame = open_seven_scenes(seven_scenes / "seq-01")[1]
    assert_same_pose(frame.world_from_cam @ frame.depth.cam_from_depth, pose(3))


def test_the_colour_camera_is_to_the_right():
    point_depth = np.array([0.0, 0.0, 2.0])
    assert COLOUR_FROM_DEPTH.translation[0] == -0.02556
    assert COLOUR_FROM_DEPTH.apply(point_depth)[0] == pytest.approx(
        -0.02556 - 0.00789 * 2.0, abs=1e-3
    )


def test_frames_without_a_pose_or_all_without_depth(seven_scenes: Path):
    run = seven_scenes / "seq-01"
    (run / "frame-000003.pose.txt").unlink()
    for path in run.glob("*.depth.png"):
        path.unlink()
    sequence = open_seven_scenes(seven_scenes)
    assert sequence.poses[1] is None
    assert sequence[0].depth is None


def test_one_of_several_runs_must_be_selected(seven_scenes: Path):
    (seven_scenes / "seq-02").mkdir()
    assert len(open_seven_scenes(seven_scenes)) == 2
    (seven_scenes / "seq-02" / "frame-000000.color.png").touch()
    with pytest.raises(RecordingError, match="seq-01, seq-02"):
        open_sequence(seven_scenes)
    assert len(open_sequence(seven_scenes / "seq-02")) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 0 0 0", "4x4"),
        ("x " * 16, "4x4"),
        ("nan " * 16, "NaN"),
        (" ".join(["1.#INF"] * 16), "4x4"),
        ("2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "rotation"),
    ],
)
def test_bad_poses(seven_scenes: Path, text: str, says: str):
    (seven_scenes / "seq-01" / "frame-000003.pose.txt").write_text(text)
    with pytest.raises(TrajectoryError, match=r"frame-000003\.pose\.txt.*" + says):
        open_seven_scenes(seven_scenes)


def test_kitchen(shared: Path):
    sequence = open_sequence(shared / "data" / "seven_scenes" / "kitchen")
    assert len(sequence) == 350
    frame = sequence[1]
    assert frame.name == "frame-000002.color.jpg"
    assert frame.t_ns == 66_666_666
    written = np.loadtxt(
        shared / "data" / "seven_scenes" / "kitchen" / "seq-01" / "frame-000002.pose.txt"
    )
    assert_same_pose(
        frame.world_from_cam @ frame.depth.cam_from_depth, Rigid3.from_matrix(written), 1e-6
    )


def test_kitchen_depth_edges_fall_on_colour_edges(shared: Path):
    """The images confirm the transform, its direction and its focal length."""
    sequence = open_sequence(shared / "data" / "seven_scenes" / "kitchen" / "seq-01")
    frames = [sequence[index] for index in range(0, 350, 25)]

    def mean_edge(cam_from_depth: Rigid3, focal: float) -> float:
        found = [
            edge_strength_at_depth_edges(frame.image, frame.depth.depth, cam_from_depth, focal)
            for frame in frames
        ]
        return float(np.nanmean(np.concatenate(found)))

    aligned = mean_edge(COLOUR_FROM_DEPTH, 525.0)
    assert aligned > 1.1 * mean_edge(COLOUR_FROM_DEPTH.inverse(), 525.0)
    assert aligned > 1.1 * mean_edge(Rigid3.identity(), 585.0)


def edge_strength_at_depth_edges(
    image: np.ndarray, depth: np.ndarray, cam_from_depth: Rigid3, focal: float
) -> np.ndarray:
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    known = np.nan_to_num(depth, nan=0.0)
    jump = cv2.dilate(known, np.ones((5, 5))) - known > 0.1 * known
    jump[:4], jump[-4:], jump[:, :4], jump[:, -4:] = False, False, False, False
    v, u = np.nonzero(jump & (known > 0))
    z = known[v, u].astype(np.float64)
    points_cam = cam_from_depth.apply(
        np.column_stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z])
    )
    pixels = (points_cam[:, :2] / points_cam[:, 2:] * focal + [320, 240]).astype(np.float32)
    found = cv2.remap(
        strength, pixels[None, :, 0], pixels[None, :, 1], cv2.INTER_LINEAR, borderValue=np.nan
    )
    return found[0] / strength.mean()
