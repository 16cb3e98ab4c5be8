"""topoloc explain MAP IMAGE."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import (
    AtlasConfig,
    Camera,
    Localization,
    Localizer,
    LocalizerConfig,
    StereoFrame,
    UncalibratedCamera,
    open_sequence,
)
from topoloc.apps.cli.features_option import (
    QUERY_FEATURES,
    CoarseOption,
    open_localizer,
    parse_camera,
)
from topoloc.apps.cli.output import (
    File,
    MaskOption,
    UsageError,
    check_outputs,
    option,
    print_line,
    write_json,
)
from topoloc.apps.cli.settings_file import read_settings, with_option
from topoloc.apps.core_names import as_monocular
from topoloc.apps.query_camera import select_frame_camera
from topoloc.apps.report.explanation import Explanation, explain, explanation_to_json
from topoloc.apps.report.explanation_page import check_row, explanation_page, row_of, verdict
from topoloc.plugin import write_text


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc explain`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas. In an atlas the tile of the result is explained."""
    image: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="IMAGE")]
    """The image, or one frame of a recording, as in walk@17."""
    camera: Annotated[
        str | None, option("FILE|fx,fy,cx,cy|map|unknown", "that of the recording")
    ] = None
    """Calibration of the image, as in `topoloc localize`."""
    mask: MaskOption = None
    coarse: CoarseOption = None
    features: QUERY_FEATURES = None
    out: File = None
    """Write a page with the images, the matches and all tried poses to this file (HTML)."""
    json: File = None
    """Write the printed facts as JSON to this file (- for standard output)."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config explain`."""

    def run(self) -> int:
        check_outputs([self.out, self.json], [self.map, self.config])
        settings = read_settings(self.config)
        config = with_option(settings.get(LocalizerConfig), "coarse", self.coarse, "--coarse")
        config = with_option(config, "mask", self.mask, "--mask")
        localizer = open_localizer(self.map, config, self.features, settings.get(AtlasConfig))
        frame = self._read_frame()
        of_size = None if self.camera is None else parse_camera(localizer, self.camera)
        camera = select_frame_camera(frame, of_size)
        tile_id, ranking = _select_tile(localizer, frame, camera)
        with localizer.in_tile(tile_id) as in_tile:
            explanation = explain(in_tile, frame.image, camera)
            if self.out:
                page = explanation_page(frame.name, frame.image, explanation, in_tile.topomap)
                write_text(Path(self.out), page)
        if self.json != "-":
            for line in [*ranking, *_report(explanation)]:
                print_line(line)
            if self.out:
                print(f"page: {self.out}")
        facts = explanation_to_json(frame.name, explanation)
        write_json(self.json, facts | ({"tiles": ranking} if ranking else {}))
        return 0

    def _read_frame(self) -> StereoFrame:
        sequence = as_monocular(open_sequence(self.image))
        if len(sequence) != 1:
            raise UsageError(
                f"explain takes one picture, and {self.image} has {len(sequence)}; {self.image}@0"
                " is its first"
            )
        return sequence[0]


def _select_tile(
    localizer: Localizer, frame: StereoFrame, camera: Camera | UncalibratedCamera
) -> tuple[str, list[str]]:
    """Return the tile of the result, and lines that explain the choice if there are several."""
    if len(localizer.tile_ids) == 1:
        return localizer.tile_ids[0], []
    result = localizer.localize(frame.image, camera)
    tile_id = result.provenance.tile or ""
    ranking = localizer.rank_tiles(frame.image, camera)[:5]
    most_similar = ", ".join(f"{name} {similarity:.2f}" for name, similarity in ranking)
    choice = f"in tile {tile_id}"
    if not isinstance(result, Localization):
        detail = f", {result.detail}" if result.detail else ""
        choice = f"not localized ({result.reason}{detail}); tile {tile_id} explains most of it"
    return tile_id, [f"atlas: {choice}", f"most similar tiles: {most_similar}"]


def _report(explanation: Explanation) -> Iterator[str]:
    """Yield the result, the advice, and a line for each tried pose and each check."""
    yield verdict(explanation)
    yield from (f"- {line}" for line in explanation.advice)
    for pose in explanation.poses:
        source, features, node, first, found, _, _, probability, became = row_of(pose)
        near, again = node and f"node {node}", found and f"found {found}"
        facts = ", ".join(filter(None, (near, f"{first} at first", again, probability)))
        yield f"  {source} ({features}): {facts}: {became}"
    for finding in explanation.findings:
        yield "  " + ": ".join(check_row(finding)[:2])
