"""topoloc calibrate MAP --rig FOLDER [--out FILE]."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import CalibrationError, Localization, Localizer, Rig, RigCamera, Rigid3
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_fields,
    print_warning,
    progress_bar,
    write_json,
)
from topoloc.apps.core_names import Mounting, find_mountings, format_length
from topoloc.apps.formats.rig import RigWalk


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc calibrate`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    rig: Annotated[str | None, option("FOLDER")] = None
    """Folder with one recording for each camera. The images of one instant have one name. The frame
    of the rig is that of its rig.json; without one it is that of the first camera."""
    out: File = None
    """Write the rig with the mountings that are found to this file (rig.json)."""
    json: File = None
    """Write the mountings with their covariances as JSON to this file (- for standard output)."""

    def run(self) -> int:
        if self.rig is None:
            raise UsageError("calibrate takes --rig FOLDER: one recording for each camera")
        check_outputs([self.out, self.json], [self.map])
        walk = _open_walk(Path(self.rig))
        reference, rig = next(iter(walk.rows)), walk.rig
        instants = _localize_instants(Localizer(self.map), walk)
        found = find_mountings(instants, reference, rig.cameras[reference].rig_from_cam)
        if len(found) == 1:
            both = sum(len(of) > 1 for of in instants)
            raise CalibrationError(
                f"{self.rig}: no mounting is found; two cameras are localized at {both} of"
                f" {len(instants)} instants, and at least 3 near different nodes must agree: take"
                " images at more places of the map"
            )
        for name in rig.cameras.keys() - found.keys():
            text = f"{name}: too few instants agree on its mounting, which stays as it was"
            print_warning(text)
        mounted = {name: _mount(one, found.get(name)) for name, one in rig.cameras.items()}
        if self.out is not None:
            write_json(self.out, Rig(mounted).to_json())
        if self.json != "-":
            print_fields([(name, _describe(one, rig, name)) for name, one in found.items()])
        write_json(self.json, {name: _to_json(one) for name, one in found.items()})
        return 0


def _open_walk(folder: Path) -> RigWalk:
    """Open a folder. Without rig.json its folders are the cameras, in alphabetical order."""
    if (folder / "rig.json").is_file():
        return RigWalk.open(folder, folder / "rig.json")
    names = sorted(one.name for one in folder.iterdir() if one.is_dir()) if folder.is_dir() else []
    if len(names) < 2:
        raise CalibrationError(
            f"{folder}: a rig has a folder of images for each camera, such as ahead/ and left/"
        )
    cameras = {name: RigCamera(Rigid3.identity()) for name in names}
    return RigWalk.of_rig(folder, Rig(cameras), str(folder))


def _localize_instants(localizer: Localizer, walk: RigWalk) -> list[dict[str, Localization]]:
    """Localize each image alone, since mountings may be wrong."""
    instants = list[dict[str, Localization]]()
    with progress_bar() as progress:
        for name in walk.names:
            images = walk.read_images(name).items()
            results = {
                camera: localizer.localize(image, walk.rig.cameras[camera].camera)
                for camera, image in images
            }
            posed = {name: one for name, one in results.items() if isinstance(one, Localization)}
            instants.append(posed)
            progress("instants", len(instants), len(walk.names))
    return instants


def _mount(before: RigCamera, found: Mounting | None) -> RigCamera:
    if found is None:
        return before
    sigmas = found.position_sigma_m, found.rotation_sigma_deg
    return replace(
        before,
        rig_from_cam=found.rig_from_cam,
        position_sigma_m=sigmas[0],
        rotation_sigma_deg=sigmas[1],
    )


def _describe(found: Mounting, rig: Rig, name: str) -> str:
    """Return one line: the mounting, its uncertainty, and how far it is from that of the file."""
    if not found.num_instants:
        return "the reference"
    x, y, z = found.rig_from_cam.translation
    w, i, j, k = found.rig_from_cam.quat_wxyz()
    moved = rig.cameras[name].rig_from_cam.inverse() @ found.rig_from_cam
    return (
        f"rig_from_cam {x:.4f} {y:.4f} {z:.4f} m, quat wxyz {w:.5f} {i:.5f} {j:.5f} {k:.5f}  sigma"
        f" {format_length(found.position_sigma_m)} {found.rotation_sigma_deg:.3f} deg "
        f" {found.num_agreeing} of {found.num_instants} instants  moved by"
        f" {format_length(float(np.linalg.norm(moved.translation)))}"
        f" {np.rad2deg(moved.angle()):.2f} deg"
    )


def _to_json(found: Mounting) -> dict[str, Any]:
    return {
        "rig_from_cam": found.rig_from_cam.to_json(),
        "covariance": found.covariance.tolist(),
        "position_sigma_m": found.position_sigma_m,
        "rotation_sigma_deg": found.rotation_sigma_deg,
        "num_agreeing": found.num_agreeing,
        "num_instants": found.num_instants,
    }
