"""Write a stereo recording in formats of other programs, map these, and localize another recording
in them, beside the stereo map.

    python benchmarks/other_formats.py RECORDING QUERIES [--map-from-truth FILE] [--formats
    nerfstudio colmap] [--out DIR]

`nerfstudio`: transforms.json with depth of 16 bits by semi-global matching of the pairs. `colmap`:
a model whose cameras and poses are those of the recording, whose points are triangulated by
pycolmap from its own SIFT features, without depth and right images.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.stored_images import encode_jpeg

sys.path.insert(0, str(Path(__file__).parent))
from variants.walks import depth_mm

COLMAP_UNIT = 2.5  # metres
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(sequence: StereoSequence, folder: Path) -> Path:
    """The left pictures with depth in millimetres, as nerfstudio has them."""
    frames = []
    for index in range(len(sequence)):
        frame = sequence[index]
        if frame.world_from_cam is None or frame.camera is None:
            continue
        name, depth_name = f"images/frame_{index:05d}.jpg", f"depth/frame_{index:05d}.png"
        _write(folder / name, encode_jpeg(frame.image, 95))
        _write(folder / depth_name, cv2.imencode(".png", depth_mm(frame))[1].tobytes())
        matrix = (frame.world_from_cam.matrix() @ GL_FROM_CV).tolist()
        frames.append(
            {"file_path": name, "depth_file_path": depth_name, "transform_matrix": matrix}
        )
    camera = sequence[0].camera
    assert camera is not None
    _, w, h, (fx, fy, cx, cy) = camera.to_colmap()
    lens = {
        "camera_model": "OPENCV",
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "w": w,
        "h": h,
        "k1": 0,
        "k2": 0,
        "p1": 0,
        "p2": 0,
    }
    (folder / "transforms.json").write_text(
        json.dumps(lens | {"depth_unit_scale_factor": 0.001, "frames": frames})
    )
    return folder


def write_colmap(sequence: StereoSequence, folder: Path) -> Path:
    """A model of the left pictures under the recording's poses, in its own unit, which is not the
    metre; the pictures lie in images/."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    pycolmap.logging.minloglevel = 2
    poses, index_of = sequence.poses, {}
    for index in range(len(sequence)):
        if poses[index] is not None:
            index_of[f"{index:05d}.jpg"] = index
            _write(folder / "images" / f"{index:05d}.jpg", encode_jpeg(sequence[index].image, 95))
    camera = sequence[0].camera
    assert camera is not None
    model, _, _, params = camera.to_colmap()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = model, ",".join(map(repr, params))
    database_path, device, names = folder / "database.db", pycolmap.Device.cpu, sorted(index_of)
    single = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database_path,
        folder / "images",
        names,
        camera_mode=single,
        reader_options=reader,
        device=device,
    )
    pairs = [
        (names[a], names[a + step])
        for step in (1, 2, 3, 5, 8, 12)
        for a in range(len(names) - step)
    ]
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(folder / "pairs.txt")
    (folder / "pairs.txt").write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pycolmap.match_image_pairs(database_path, pairing_options=pairing, device=device)
    known = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        for of_database in database.read_all_cameras():
            known.add_camera_with_trivial_rig(of_database)
        for name in names:
            image, pose = database.read_image_with_name(name), poses[index_of[name]]
            assert pose is not None
            bare = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=image.image_id)
            known.add_image_with_trivial_frame(bare, pycolmap.Rigid3d(pose.inverse().matrix()[:3]))
    (folder / "sparse").mkdir(exist_ok=True)
    found = pycolmap.triangulate_points(known, database_path, folder / "images", folder / "sparse")
    found.transform(pycolmap.Sim3d(1.0 / COLMAP_UNIT, pycolmap.Rotation3d(), np.zeros(3)))
    found.write(folder / "sparse")
    return folder / "sparse"


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _topoloc(*arguments: str) -> None:
    print("topoloc", *arguments, flush=True)
    subprocess.run([sys.executable, "-m", "topoloc", *arguments], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording")
    parser.add_argument("queries")
    parser.add_argument("--map-from-truth")
    parser.add_argument("--formats", nargs="*", default=["stereo", "nerfstudio"])
    parser.add_argument("--out", type=Path, default=Path("out/other_formats"))
    options = parser.parse_args()
    sequence = open_sequence(options.recording)
    world = ["--map-from-truth", options.map_from_truth] if options.map_from_truth else []
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.formats:
        source, more = options.recording, []
        if name == "nerfstudio":
            shutil.rmtree(options.out / name, ignore_errors=True)
            source = str(write_nerfstudio(sequence, options.out / name))
        if name == "colmap":
            shutil.rmtree(options.out / name, ignore_errors=True)
            source = str(write_colmap(sequence, options.out / name))
            more = ["--images", str(options.out / name / "images"), "--scale", str(COLMAP_UNIT)]
        target = str(options.out / f"{name}.topo")
        _topoloc("build", source, target, "--features", "surf", *more)
        _topoloc(
            "evaluate", target, options.queries, "--json", str(options.out / f"{name}.json"), *world
        )


if __name__ == "__main__":
    main()
