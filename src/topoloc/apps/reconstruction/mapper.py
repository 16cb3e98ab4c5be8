"""Compute the poses of matched images with pycolmap's incremental mapper.

Run as `python -m topoloc.apps.reconstruction.mapper FOLDER`. It is a process of its own: pycolmap
can abort in a process that has loaded OpenCV, and a limit of memory holds for it alone. FOLDER has
the matches (`views.npz`, of `photos.py`) and gets snapshots, from which a stopped run continues,
and the result (`poses.npz`).
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

_SNAPSHOT_FRAMES = 25
_MEMORY_SHARE = 0.75  # of the machine's memory that this process may use


def main(folder: Path) -> None:
    """Write `poses.npz` from `views.npz`, and print the number of images with a pose as it grows.

    `poses.npz` holds for each image its part (0 is the largest; -1 without a pose),
    `cam_from_world` (n, 3, 4) in an arbitrary unit, and its camera as JSON; and of the points that
    images of part 0 see: row of the image, pixel (COLMAP's centre) and depth.
    """
    import pycolmap

    _limit_memory()
    pycolmap.logging.minloglevel = 3
    views = dict(np.load(folder / "views.npz"))
    database, snapshots = folder / "database.db", folder / "snapshots"
    if not database.is_file():
        _write_database(pycolmap, views, database.with_suffix(".part"))
        database.with_suffix(".part").rename(database)
    snapshots.mkdir(exist_ok=True)
    options = _options(pycolmap, views, snapshots)
    last = _latest_snapshot(snapshots)
    count = [0 if last is None else pycolmap.Reconstruction(str(last)).num_reg_images()]

    def print_count() -> None:
        count[0] += 1
        print(count[0], flush=True)

    models = pycolmap.incremental_mapping(
        database,
        folder,
        folder / "models",
        options,
        input_path=last or "",
        next_image_callback=print_count,
    )
    found = sorted(models.values(), key=lambda one: -one.num_reg_images())
    _write_result(found, len(views["camera_of_image"]), folder)
    for name in ("snapshots", "models"):
        shutil.rmtree(folder / name, ignore_errors=True)


def _options(pycolmap: Any, views: dict[str, Any], snapshots: Path) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors, options.min_model_size = 0, False, 3
    options.snapshot_path, options.snapshot_frames_freq = str(snapshots), _SNAPSHOT_FRAMES
    options.constant_cameras = {
        number for number, one in _cameras(views).items() if one["is_known"]
    }
    return options


def _cameras(views: dict[str, Any]) -> dict[int, dict[str, Any]]:
    return dict(enumerate(json.loads(str(views["cameras"])), start=1))


def _write_database(pycolmap: Any, views: dict[str, Any], path: Path) -> None:
    """Write images, key points and verified pairs. Numbers of COLMAP begin at 1."""
    path.unlink(missing_ok=True)
    database = pycolmap.Database.open(path)
    for number, one in _cameras(views).items():
        camera = pycolmap.Camera(camera_id=number, **one["colmap"])
        camera.has_prior_focal_length = one["has_focal"]
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    points = np.split(views["points_img"], np.cumsum(views["num_points"])[:-1])
    for number, camera_id in enumerate(views["camera_of_image"].tolist(), start=1):
        image = pycolmap.Image(name=f"{number}", camera_id=camera_id, image_id=number)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=number, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(number, points[number - 1] + np.float32(0.5))
    matches = np.split(views["matches"], np.cumsum(views["num_matches"])[:-1])
    for (first, second), rows in zip((views["pairs"] + 1).tolist(), matches, strict=True):
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        geometry.inlier_matches = rows
        database.write_matches(first, second, rows)
        database.write_two_view_geometry(first, second, geometry)
    database.close()


def _latest_snapshot(folder: Path) -> Path | None:
    """Return the newest whole snapshot. Their names are times."""
    whole = [one for one in folder.iterdir() if (one / "points3D.bin").is_file()]
    return max(whole, default=None)


def _write_result(models: list[Any], num_images: int, folder: Path) -> None:
    parts, poses = np.full(num_images, -1), np.full((num_images, 3, 4), np.nan)
    cameras, seen = [""] * num_images, list[tuple[float, ...]]()
    for part, model in enumerate(models):
        for image in model.images.values():
            row = image.image_id - 1
            if not image.has_pose or parts[row] >= 0:
                continue
            parts[row], poses[row] = part, image.cam_from_world().matrix()
            camera = model.cameras[image.camera_id]
            size = camera.width, camera.height
            cameras[row] = json.dumps([camera.model_name, *size, list(camera.params)])
            for point in image.points2D if part == 0 else ():
                if point.has_point3D():
                    at = model.points3D[point.point3D_id]
                    depth = poses[row, 2, :3] @ at.xyz + poses[row, 2, 3]
                    seen.append((row, *point.xy, depth))
    part_file = folder / "poses.part.npz"
    points = np.array(seen, np.float64).reshape(-1, 4)
    np.savez(part_file, parts=parts, cam_from_world=poses, cameras=np.array(cameras), seen=points)
    part_file.rename(folder / "poses.npz")


def _limit_memory() -> None:
    with contextlib.suppress(ImportError, OSError, ValueError):  # Windows; a lower limit is set
        import resource

        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        most = int(_MEMORY_SHARE * total)
        resource.setrlimit(
            resource.RLIMIT_DATA, (most, resource.getrlimit(resource.RLIMIT_DATA)[1])
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
