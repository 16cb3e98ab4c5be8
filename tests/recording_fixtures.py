"""Provide tiny recordings of each format, with known images, times and poses."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import (
    BODY_FROM_CAM,
    CALIB,
    CAMERA,
    EUROC_TIMES,
    HEIGHT,
    WIDTH,
    kitti_row,
    picture,
    pose,
    sensor_yaml,
    tum_line,
    write,
)


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Return three grey pairs at 0, 0.1, 0.2 s, with KITTI's poses beside `sequences`."""
    folder = tmp_path / "sequences" / "07"
    for index in range(3):
        write(folder / "image_0" / f"{index:06d}.png", picture(index))
        write(folder / "image_1" / f"{index:06d}.png", picture(100 + index))
    (folder / "calib.txt").write_text(CALIB)
    (folder / "times.txt").write_text("0.000000e+00\n1.000000e-01\n2.000000e-01\n")
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "07.txt").write_text(
        "\n".join(kitti_row(pose(index)) for index in range(3))
    )
    return folder


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    """Return four pairs 50 ms apart. The second image of cam1 is missing. The body's truth is at
    the times of the first and last two."""
    for camera in (0, 1):
        folder = tmp_path / "v1" / "mav0" / f"cam{camera}"
        rows = ["#timestamp [ns],filename"]
        for index, t_ns in enumerate(EUROC_TIMES):
            if (camera, index) == (1, 1):
                continue
            write(folder / "data" / f"{t_ns}.png", picture(100 * camera + index))
            rows.append(f"{t_ns},{t_ns}.png\r")
        (folder / "data.csv").write_text("\n".join(rows) + "\n")
        (folder / "sensor.yaml").write_text(sensor_yaml(BODY_FROM_CAM[camera]))
    return tmp_path / "v1"


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    """Return three colour images with truth at all times. The second has no depth image near
    enough in time."""
    folder = tmp_path / "rgbd_dataset_freiburg1_tiny"
    times = ["1305031102.175304", "1305031102.211214", "1305031102.275326"]
    depths = ["1305031102.160407", "1305031102.236000", "1305031102.280000"]
    for index, (time, depth) in enumerate(zip(times, depths, strict=True)):
        write(folder / "rgb" / f"{time}.png", picture(index, 3, 640, 480))
        write(folder / "depth" / f"{depth}.png", np.full((480, 640), 5000 * (index + 1), np.uint16))
    (folder / "rgb.txt").write_text(
        "# colour\n" + "".join(f"{time} rgb/{time}.png\n" for time in times)
    )
    (folder / "depth.txt").write_text(
        "# depth\n" + "".join(f"{time} depth/{time}.png\n" for time in depths)
    )
    (folder / "groundtruth.txt").write_text(
        "# truth\n" + "".join(tum_line(time, pose(i)) + "\n" for i, time in enumerate(times))
    )
    return folder


@pytest.fixture
def seven_scenes(tmp_path: Path) -> Path:
    """Return a scene with one run of two frames, 0 and 3."""
    folder = tmp_path / "office" / "seq-01"
    for number in (0, 3):
        stem = f"frame-{number:06d}"
        write(folder / f"{stem}.color.png", picture(number, 3, 640, 480))
        depth = np.full((480, 640), 1500, np.uint16)
        depth[0, :2] = 0, 65535
        write(folder / f"{stem}.depth.png", depth)
        np.savetxt(folder / f"{stem}.pose.txt", pose(number).matrix())
    return folder.parent


@pytest.fixture
def plain(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes three images to each named folder, and a camera.json of CAMERA
    with these keys, if any."""

    def make(*folders: str, **camera_keys: float) -> Path:
        root = tmp_path / "plain"
        for number, folder in enumerate(folders):
            for index in (1, 2, 10):
                pixels = (
                    np.full((HEIGHT, WIDTH), 100 * index, np.uint16)
                    if folder == "depth"
                    else picture(100 * number + index)
                )
                write(root / folder / f"view{index}.png", pixels)
        if camera_keys:
            (root / "camera.json").write_text(json.dumps(CAMERA | camera_keys))
        return root

    return make


@pytest.fixture
def quiet(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Check that nothing was written to stderr, not even by a library."""
    yield
    assert capfd.readouterr().err == ""
