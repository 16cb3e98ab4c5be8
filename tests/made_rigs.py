"""Make rigs of the images that one camera took one after the other: truth gives their mountings."""

from __future__ import annotations

import tempfile
from pathlib import Path

from made_once import once_a_run
from topoloc import Image, Rig, RigCamera, Rigid3, build_map, open_sequence
from topoloc.demo.recordings import SHIPPED

NAMES = ("a", "b", "c")


@once_a_run
def _lab_map() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lab.topo"
        build_map(open_sequence(SHIPPED / "map_lap1")).save(path)
        return path.read_bytes()


def lab_map(folder: Path) -> Path:
    """Write the map of the demo's lab and return its path."""
    path = folder / "lab.topo"
    path.write_bytes(_lab_map())
    return path


def instant(first: int, step: int = 4) -> tuple[Rig, dict[str, Image], Rigid3]:
    """Return a rig of three cameras, their images and the true world_from_rig."""
    frames = [open_sequence(SHIPPED / "day")[first + k * step] for k in range(len(NAMES))]
    world_from_rig = frames[0].world_from_cam
    assert world_from_rig is not None
    cameras = dict[str, RigCamera]()
    for name, frame in zip(NAMES, frames, strict=True):
        assert frame.world_from_cam is not None
        cameras[name] = RigCamera(world_from_rig.inverse() @ frame.world_from_cam, frame.camera)
    images = {name: frame.image for name, frame in zip(NAMES, frames, strict=True)}
    return Rig(cameras), images, world_from_rig
