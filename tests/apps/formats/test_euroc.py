from pathlib import Path
from time import perf_counter

import numpy as np
import pytest

from tiny_recordings import BODY_FROM_CAM, EUROC_TIMES, assert_same_pose, picture, pose, sensor_yaml
from topoloc.apps.formats.euroc import open_euroc, read_sensor
from topoloc.errors import CalibrationError, RecordingError, TrajectoryError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence

MILLISECOND = 1_000_000


def write_truth(euroc: Path, times: list[int], poses: list[Rigid3]) -> Path:
    path = euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    path.parent.mkdir(parents=True)
    rows = ["#timestamp, p_RS_R_x [m], ..."]
    for time, found in zip(times, poses, strict=True):
        values = (*found.translation, *found.quat_wxyz(), 0.1, 0.2, 0.3)
        rows.append(f"{time}," + ",".join(f"{value:.12f}" for value in values))
    path.write_text("\n".join(rows))
    return path


def test_pairs_are_of_equal_times(euroc: Path):
    sequence = open_euroc(euroc)
    assert sequence.name == "v1"
    assert sequence.t_ns == [EUROC_TIMES[index] for index in (0, 2, 3)]
    assert sequence.names[1] == f"mav0/cam0/data/{EUROC_TIMES[2]}.png"
    np.testing.assert_array_equal(sequence[1].image, picture(2))
    np.testing.assert_array_equal(sequence[1].right, picture(102))
    assert sequence.poses == [None] * 3
    of_mav = open_euroc(euroc / "mav0")
    assert of_mav.name == "v1"
    np.testing.assert_array_equal(of_mav[1].image, picture(2))


def test_times_that_differ_by_nanoseconds(euroc: Path):
    path = euroc / "mav0" / "cam1" / "data.csv"
    delays = {EUROC_TIMES[0]: -40, EUROC_TIMES[2]: 900_000, EUROC_TIMES[3]: 1_100_000}
    rows = [f"{time + delay},{time}.png" for time, delay in delays.items()]
    path.write_text("\n".join(rows))
    sequence = open_euroc(euroc)
    assert sequence.t_ns == [EUROC_TIMES[0], EUROC_TIMES[2]]
    np.testing.assert_array_equal(sequence[1].right, picture(102))
    (note,) = sequence.notes
    assert "2 of 4 pictures of cam0 have none of cam1 (3) within 1 ms and are left out" in note


def camchain(motion: str, **matrices: np.ndarray) -> str:
    """Return Kalibr's file of the two cameras. cam1 has `motion` beside its mounting."""
    text = ""
    for number, body_from_cam in enumerate(BODY_FROM_CAM):
        sensor = sensor_yaml(body_from_cam).split("\n")
        lines = [line for line in sensor if line.split(":")[0] in ("resolution", "intrinsics")]
        text += f"cam{number}:\n" + "".join(f"  {line}\n" for line in lines)
        text += "  camera_model: pinhole\n  distortion_model: radtan\n"
        text += "  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]\n"
        for key, matrix in ((motion, matrices["chain"]),) if number and motion else ():
            text += f"  {key}:\n" + "".join(f"  - {row}\n" for row in matrix.tolist())
        for key, of in (("T_cam_imu", body_from_cam.inverse()), ("T_imu_cam", body_from_cam)):
            if key in matrices:
                rows = of.matrix().tolist()
                text += f"  {key}:\n" + "".join(f"  - {row}\n" for row in rows)
    return text


@pytest.mark.parametrize("key", ["T_cam_imu", "T_imu_cam"])
@pytest.mark.parametrize("motion", ["T_cn_cnm1", ""])
@pytest.mark.parametrize("place", ["camchain.yaml", "dso/camchain.yaml", "../given.yaml"])
def test_kalibrs_file_in_place_of_sensor_yaml(euroc: Path, key: str, motion: str, place: str):
    write_truth(euroc, EUROC_TIMES, [pose(index) for index in range(4)])
    expected = open_euroc(euroc)
    for number in (0, 1):
        (euroc / "mav0" / f"cam{number}" / "sensor.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"cam0/sensor\.yaml: no calibration here"):
        open_sequence(euroc)
    chain = (BODY_FROM_CAM[1].inverse() @ BODY_FROM_CAM[0]).matrix()
    (euroc / place).parent.mkdir(exist_ok=True)
    (euroc / place).write_text(camchain(motion, chain=chain, **{key: chain}))
    sequence = open_sequence(euroc, camera=euroc / place if place.startswith("..") else None)
    assert sequence.t_ns == expected.t_ns
    for found, other in zip(sequence, expected, strict=True):
        assert found.rig.left == other.rig.left
        assert_same_pose(found.rig.right_from_left, other.rig.right_from_left)
        assert_same_pose(found.world_from_cam, other.world_from_cam)


def test_one_camera_in_place_of_a_pair(euroc: Path):
    (euroc / "mav0" / "cam0" / "sensor.yaml").unlink()
    with pytest.raises(CalibrationError, match="--camera needs a file of both cameras"):
        open_sequence(euroc, camera="45,45,16,12")


def test_rig(euroc: Path):
    frame = open_euroc(euroc)[0]
    assert frame.camera == Camera(
        "OPENCV", 32, 24, (45.5, 45.25, 16.5, 12.5, -0.28, 0.07, 0.0002, 1.7e-05)
    )
    assert not frame.rig.is_rectified
    point_left = np.array([0.3, -0.2, 4.0])
    point_right = BODY_FROM_CAM[1].inverse().apply(BODY_FROM_CAM[0].apply(point_left))
    np.testing.assert_allclose(frame.rig.right_from_left.apply(point_left), point_right, atol=1e-12)


def test_truth_is_the_left_cameras(euroc: Path):
    t0, _, t2, t3 = EUROC_TIMES
    # Frame 0 in the middle of a gap of 40 ms, frame 2 in one of 80 ms, frame 3 exact.
    times = [
        t0 - 20 * MILLISECOND,
        t0 + 20 * MILLISECOND,
        t2 - 45 * MILLISECOND,
        t2 + 35 * MILLISECOND,
        t3,
    ]
    poses = [Rigid3(np.eye(3), np.array([float(index), 0.0, 0.0])) for index in range(4)] + [
        pose(3)
    ]
    write_truth(euroc, times, poses)
    sequence = open_euroc(euroc)
    middle = Rigid3(np.eye(3), np.array([0.5, 0.0, 0.0]))
    assert_same_pose(sequence[0].world_from_cam, middle @ BODY_FROM_CAM[0])
    assert sequence.poses[1] is None
    assert_same_pose(sequence.poses[2], pose(3) @ BODY_FROM_CAM[0])


def test_truth_of_other_times_or_broken(euroc: Path):
    path = write_truth(euroc, [10**18], [pose(0)])
    with pytest.raises(TrajectoryError, match=r"data\.csv: none of the 3"):
        open_euroc(euroc)
    path.write_text("1,2,3\n")
    with pytest.raises(TrajectoryError, match=r"data\.csv, line 1: 3 columns"):
        open_euroc(euroc)
    path.write_text("# nothing\n")
    with pytest.raises(TrajectoryError, match="nothing in"):
        open_euroc(euroc)


def test_left_pictures_alone(euroc: Path):
    (euroc / "mav0" / "cam1" / "data.csv").unlink()
    sequence = open_euroc(euroc)
    assert len(sequence) == 4
    assert sequence[1].rig is None


def test_a_listed_picture_that_is_missing(euroc: Path):
    (euroc / "mav0" / "cam1" / "data" / f"{EUROC_TIMES[2]}.png").unlink()
    sequence = open_euroc(euroc)
    assert sequence[0].right is not None
    with pytest.raises(UnreadableImageError, match=f"cam1/data/{EUROC_TIMES[2]}.png: no such"):
        sequence[1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("# none\n", "nothing in"),
        ("123\n", "line 1"),
        ("a,a.png\n", "line 1.*not a time"),
        ("2,2.png\n1,1.png\n", "line 2.*not after"),
    ],
)
def test_bad_lists(euroc: Path, text: str, says: str):
    (euroc / "mav0" / "cam0" / "data.csv").write_text(text)
    with pytest.raises(RecordingError, match=r"data\.csv.*" + says):
        open_euroc(euroc)


def test_no_pair(euroc: Path):
    (euroc / "mav0" / "cam1" / "data.csv").write_text("1,1.png\n")
    with pytest.raises(RecordingError, match=r"4 of 4 pictures of cam0 have none of cam1 \(1\)"):
        open_euroc(euroc)


def test_fisheye_and_other_styles_of_yaml(tmp_path: Path):
    path = tmp_path / "sensor.yaml"
    path.write_text(sensor_yaml(BODY_FROM_CAM[0], "equidistant"))
    assert read_sensor(path).camera.model == "OPENCV_FISHEYE"
    path.write_text(
        "T_BS:\n- [1.0, 0.0, 0.0, 0.5]\n- [0.0, 1.0, 0.0, 0.25]\n- [0.0, 0.0, 1.0, 1e-1]\n- [0.0,"
        " 0.0, 0.0, 1.0]\nresolution:\n- 512\n- 512\nintrinsics: [190., 191, 254.5,"
        " 255]\ndistortion_model: none\n"
    )
    sensor = read_sensor(path)
    assert sensor.camera == Camera.pinhole(512, 512, 190.0, 191.0, 254.5, 255.0)
    np.testing.assert_allclose(sensor.body_from_cam.translation, [0.5, 0.25, 0.1])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("distortion_model: radial-tangential", "distortion_model: fov", "fov"),
        ("camera_model: pinhole", "camera_model: omni", "pinhole"),
        ("intrinsics: [45.5, ", "intrinsics: [", "intrinsics with 4"),
        ("T_BS", "T_SB", "T_BS with 16"),
        ("resolution", "size", "resolution with 2"),
        ("[45.5,", "[-45.5,", "positive"),
    ],
)
def test_bad_sensors(tmp_path: Path, old: str, new: str, says: str):
    (tmp_path / "sensor.yaml").write_text(sensor_yaml(BODY_FROM_CAM[0]).replace(old, new))
    with pytest.raises(CalibrationError, match=r"sensor\.yaml.*" + says):
        read_sensor(tmp_path / "sensor.yaml")


def test_blank_lines_cost_no_more_than_comments(tmp_path: Path):
    path, seconds = tmp_path / "sensor.yaml", list[float]()
    for line in ("# a comment of forty characters, no more\n", " \n"):
        path.write_text(line * (990_000 // len(line)) + sensor_yaml(BODY_FROM_CAM[0]))
        start = perf_counter()
        assert read_sensor(path).camera.fx == 45.5
        seconds.append(perf_counter() - start)
    assert seconds[1] < 20 * max(seconds[0], 0.1)


def test_no_sensor_and_no_rotation(euroc: Path, tmp_path: Path):
    bent = Rigid3(np.diag([2.0, 1.0, 1.0]), np.zeros(3))
    (tmp_path / "sensor.yaml").write_text(sensor_yaml(bent))
    with pytest.raises(CalibrationError, match="rotation"):
        read_sensor(tmp_path / "sensor.yaml")
    (euroc / "mav0" / "cam1" / "sensor.yaml").write_text(sensor_yaml(BODY_FROM_CAM[0]))
    with pytest.raises(CalibrationError, match=r"cam1/sensor\.yaml.*baseline of"):
        open_euroc(euroc)
    (euroc / "mav0" / "cam1" / "sensor.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"cam1/sensor\.yaml: no calibration"):
        open_euroc(euroc)


def test_real_recording(shared: Path):
    sequence = open_euroc(shared / "data" / "euroc" / "v1_01_part")
    assert len(sequence) == 50
    frame = sequence[0]
    assert frame.t_ns == 1403715273262142976
    assert frame.image.shape == frame.right.shape == (480, 752)
    assert frame.camera.params == (
        458.654,
        457.296,
        367.215,
        248.375,
        -0.28340811,
        0.07395907,
        0.00019359,
        1.76187114e-05,
    )
    assert frame.rig.baseline == pytest.approx(0.11007, abs=1e-4)
    assert frame.rig.right_from_left.translation[0] < -0.1
