"""topoloc scale MAP: set the scale of a map of images, or correct it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from topoloc import (
    Camera,
    GeoreferenceError,
    MemorySequence,
    Rigid3,
    StereoFrame,
    TopoMetricMap,
    TopoNode,
)
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    open_recording,
    option,
    print_line,
    print_waiting,
    print_warning,
    write_json,
)
from topoloc.apps.core_names import rescale_map
from topoloc.apps.georeferencing.georeference import read_gnss
from topoloc.apps.reconstruction.gnss import fit_places, read_exif_places
from topoloc.apps.reconstruction.photos import PosedView, Reconstruction, SeenPoints
from topoloc.apps.reconstruction.scale import ScaleSource, find_scale


@dataclass(frozen=True)
class Command:
    """Options of `topoloc scale`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file, all lengths of which are changed. `topoloc undo` takes it back."""
    distance: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="IMAGE_A,IMAGE_B=METRES", help_behavior_hint="(several times)"),
    ] = ()
    """A measured distance between the cameras of two mapping images."""
    tag: Annotated[float | None, option("METRES")] = None
    """Side of printed AprilTags or ArUco markers that mapping images show."""
    gnss: Annotated[str | None, option("exif|FILE")] = None
    """Positions of the camera: those in the EXIF data of the photos; or a file of lines
    `time,lat,lon,h` or `name of a mapping image,lat,lon,h`."""
    images: Annotated[str | None, option("PHOTOS", "where the map has them from")] = None
    """Photos of the map, for --tag and EXIF. If they are gone, its own small images serve."""
    json: File = None
    """Write the result as JSON to this file (- for standard output)."""

    def run(self) -> int:
        if not self.distance and self.tag is None and self.gnss is None:
            raise UsageError(
                "scale takes --distance IMAGE_A,IMAGE_B=METRES, --tag METRES, or --gnss exif|FILE"
            )
        if self.tag is not None and not 0.0 < self.tag < 100.0:
            raise UsageError(f"--tag is the side of a tag in metres, such as 0.16, not {self.tag}")
        if malformed := [text for text in self.distance if "=" not in text]:
            raise UsageError(f"--distance is IMAGE_A,IMAGE_B=3.2m, not {malformed[0][:80]}")
        check_outputs([self.json], [self.map, self.images, self.gnss])
        tell = None if self.json == "-" else print_line
        with TopoMetricMap.load(self.map) as topomap:
            is_exif = self.gnss == "exif"
            views = list(_read_views(topomap, self.images, is_exif or self.tag is not None))
            no_points = [SeenPoints(np.zeros((0, 2)), np.zeros(0))] * sum(map(len, views))
            found = Reconstruction(views, no_points, is_fitted=True)  # perhaps
            known = self._measure_gnss(topomap, found)
            scale = find_scale(found, self.distance, self.tag, tell, print_warning, known)
            before = topomap.config.scale_sigma
        rescale_map(self.map, scale.metres, scale.sigma, print_waiting)
        self._report(scale, before)
        return 0

    def _measure_gnss(self, topomap: TopoMetricMap, found: Reconstruction) -> list[ScaleSource]:
        """Return the scale by --gnss FILE. Raises GeoreferenceError: it, or EXIF, gives none."""
        if self.gnss is None:
            return []
        is_exif = self.gnss == "exif"
        if is_exif:
            positions, places = read_exif_places(found)
        else:
            points = read_gnss(Path(self.gnss), topomap)
            positions, places = points.points_world, points.places
        if (fit := fit_places(positions, places)) is None:
            raise GeoreferenceError(
                f"--gnss {self.gnss}: {len(places)} places of mapping images give no scale; take 8"
                " or more over tens of metres, or --distance IMAGE_A,IMAGE_B=METRES"
            )
        return [] if is_exif else [ScaleSource(f"GNSS in {self.gnss}", *fit)]

    def _report(self, scale: ScaleSource, before: float | None) -> None:
        if self.json != "-":
            unit = "unit" if before is None else "metre of before"
            print_line(
                f"{self.map}: {scale.metres:.5g} m in a {unit}, +- {100 * scale.sigma:.1f} %"
            )
        write_json(self.json, {"factor": scale.metres, "scale_sigma": scale.sigma})


def _read_views(
    topomap: TopoMetricMap, photos: str | None, with_pixels: bool
) -> Iterator[PosedView]:
    """Yield the mapping images of each session with their poses, and the cameras of nodes: photos,
    if they are there and pixels are needed, else the nodes' images. Raises RecordingError."""
    for session in topomap.sessions:
        nodes = {
            node.summary.name: node
            for node in topomap.nodes
            if node.summary.session_id == session.session_id
        }
        poses = {
            one.name: one.world_from_cam
            for one in (*topomap.place_images, *topomap.summaries)
            if one.session_id == session.session_id
        }
        path = photos or session.recording
        if with_pixels and path is not None and (photos or os.path.exists(path)):
            base = open_recording(path, None)
            if any(name in nodes for name in base.names):
                known = [poses.get(name) for name in base.names]
                cameras = [nodes[name].camera if name in nodes else None for name in base.names]
                yield PosedView(base, list(range(len(base))), known, cameras=cameras)
                continue
        yield _view_nodes(session.name, nodes, poses)


def _view_nodes(name: str, nodes: dict[str, TopoNode], poses: dict[str, Rigid3]) -> PosedView:
    """Return the images of nodes, and frames without camera for other mapping images."""
    frames, cameras = list[StereoFrame](), list[Camera | None]()
    for number, image_name in enumerate(poses):
        image = nodes[image_name].read_image() if image_name in nodes else None
        camera = None if image is None else nodes[image_name].camera
        image = np.zeros((8, 8), np.uint8) if image is None else image
        of_size = (camera or Camera.pinhole(8, 8, 8.0, 8.0, 3.5, 3.5)).rescaled(
            image.shape[1], image.shape[0]
        )
        frames.append(StereoFrame(image_name, number * 10**9, image, of_size))
        cameras.append(camera)
    rows = list(range(len(frames)))
    return PosedView(MemorySequence(frames, name), rows, [*poses.values()], cameras=cameras)
