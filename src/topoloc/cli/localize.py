"""topoloc localize MAP INPUT ..."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.cli.output import progress_bar, write_text
from topoloc.errors import CalibrationError, QueryError, TopolocError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.open import open_sequence


@dataclass(frozen=True)
class Command:
    """What `topoloc localize` takes."""

    map: tyro.conf.Positional[str]
    """The map file."""
    inputs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="INPUT ...")]
    """Images, folders of images, recordings. PATH@0:100 takes the first hundred frames of PATH."""
    camera: str | None = None
    """The queries' calibration: a camera.json, `fx,fy,cx,cy` in pixels, or `map` for the camera that the map was made with. Where
    a recording brings its own, that is used."""
    format: str | None = None
    """The recordings' format, where it is not recognised by itself."""
    coarse: str = "surf-vlad"
    """Which of the map's coarse localizers is asked."""
    json: str | None = None
    """Write one JSON line a query to this file (- for standard output)."""
    tum: str | None = None
    """Write the poses found to this file, TUM format (t tx ty tz qx qy qz qw, world_from_cam)."""
    config: LocalizerConfig = field(default_factory=LocalizerConfig)

    def run(self) -> int:
        if not self.inputs:
            raise TopolocError("localize takes a map and at least one image, folder or recording")
        topomap = TopoMetricMap.load(self.map)
        localizer = Localizer(topomap, replace(self.config, coarse=self.coarse))
        sequences = [open_sequence(path, self.format) for path in self.inputs]
        answers = []
        with progress_bar() as progress:
            total = sum(map(len, sequences))
            for query, t_ns, result in self._answers(localizer, topomap, sequences):
                answers.append((query, t_ns, result))
                if self.json != "-":
                    print(_line(query, result), flush=True)
                else:
                    print(json.dumps(result.to_json(query)), flush=True)
                progress("queries", len(answers), total)
        self._write_files(answers)
        return self._status(answers)

    def _answers(
        self, localizer: Localizer, topomap: TopoMetricMap, sequences: list[StereoSequence]
    ) -> Iterator[tuple[str, int, Localization | NotLocalized]]:
        for path, sequence in zip(self.inputs, sequences, strict=True):
            for i, name in enumerate(sequence.names):
                query = name if len(self.inputs) == 1 else f"{path}/{name}"
                try:
                    frame = sequence[i]
                except UnreadableImageError as error:
                    yield query, sequence.t_ns[i], NotLocalized("unreadable", detail=str(error))
                    continue
                height, width = frame.image.shape[:2]
                camera = frame.camera if self.camera is None else _parse_camera(self.camera, width, height, topomap)
                if camera is None:
                    raise CalibrationError(
                        f"{path}: no calibration; give --camera FILE, --camera fx,fy,cx,cy or --camera map (that of the map)"
                    )
                yield query, sequence.t_ns[i], localizer.localize(frame.image, camera)

    def _write_files(self, answers: list[tuple[str, int, Localization | NotLocalized]]) -> None:
        if self.json not in (None, "-"):
            write_text(Path(self.json), "".join(json.dumps(result.to_json(query)) + "\n" for query, _, result in answers))
        if self.tum is not None:
            from topoloc.sequences.trajectory import Trajectory, write_tum

            found = sorted((t_ns, result.world_from_cam) for _, t_ns, result in answers if isinstance(result, Localization))
            write_tum(Trajectory([t for t, _ in found], [pose for _, pose in found]), Path(self.tum))

    def _status(self, answers: list[tuple[str, int, Localization | NotLocalized]]) -> int:
        unreadable = [result for _, _, result in answers if isinstance(result, NotLocalized) and result.reason == "unreadable"]
        for result in unreadable:
            print(f"error: {result.detail}", file=sys.stderr)
        return 1 if unreadable and len(unreadable) == len(answers) else 0


def _parse_camera(text: str, width: int, height: int, topomap: TopoMetricMap) -> Camera:
    """The camera of `--camera` for an image of this size."""
    if text == "map":
        camera = topomap.nodes[0].camera
        if width * camera.height != height * camera.width:
            raise QueryError(f"the image is {width}x{height}, the map's camera {camera.width}x{camera.height}: not of one shape")
        return camera.rescaled(width, height)
    parts = text.split(",")
    if len(parts) == 4:
        try:
            return Camera.pinhole(width, height, *map(float, parts))
        except ValueError:
            raise CalibrationError(f"--camera {text}: four numbers fx,fy,cx,cy are needed") from None
    try:
        return Camera.from_json(json.loads(Path(text).read_text()))
    except OSError as error:
        raise CalibrationError(f"--camera {text}: {error.strerror}") from None
    except ValueError as error:
        raise CalibrationError(f"--camera {text}: not JSON ({error})") from None


def _line(query: str, result: Localization | NotLocalized) -> str:
    """One query for people."""
    ms = f"{result.times_ms['total']:.0f} ms" if result.times_ms else ""
    if isinstance(result, NotLocalized):
        return f"{query}  not localized: {result.reason}  ({result.num_inliers} of {result.num_matches} matches)  {ms}"
    x, y, z = result.world_from_cam.translation
    w, i, j, k = result.world_from_cam.quat_wxyz()
    return (
        f"{query}  at {x:.3f} {y:.3f} {z:.3f} m, quat wxyz {w:.4f} {i:.4f} {j:.4f} {k:.4f}  p {result.probability:.2f}"
        f"  node {result.node_id}  ({result.num_inliers} of {result.num_matches} matches)  {ms}"
    )
