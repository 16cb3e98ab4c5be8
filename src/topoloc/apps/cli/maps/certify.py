"""topoloc certify MAP [--walk SEQ ...] [--out-of-map SEQ ...]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from topoloc import (
    Certification,
    LocalizerConfig,
    MissingExtraError,
    PoseConventions,
    StereoSequence,
    TopoMetricMap,
    certify,
    with_pose_conventions,
)
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Flag,
    Format,
    MaskOption,
    PosesOption,
    UsageError,
    check_outputs,
    open_recording,
    option,
    print_fields,
    print_line,
    print_quarters,
    print_waiting,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.queries.evaluate import read_rigid
from topoloc.apps.cli.settings_file import read_settings, with_option
from topoloc.apps.quality.certificate_texts import (
    describe_condition,
    describe_group,
    describe_limits,
)
from topoloc.apps.report.plotting import load_matplotlib

Recordings = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(metavar="SEQ", help_behavior_hint="(may be given several times)"),
]


@dataclass(frozen=True)
class Command:
    """Options of `topoloc certify`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file. The certificate is stored in it as an edit, which `topoloc undo` removes."""
    walk: Recordings = ()
    """A recording of the place that is not in the map. With true poses, wrong answers are counted;
    without them, only how many images are localized."""
    out_of_map: Recordings = ()
    """A folder of images or a recording of another place. Each pose is wrong."""
    map_from_truth: File = None
    """JSON file with the 4x4 transform (metres) from the world of the true poses to the map's."""
    max_wrong: Annotated[float, option("PERCENT")] = 1.0
    """The promise that is asked for: the most independent images with a wrong answer, in percent.
    0.5 needs at least 736 independent images of each kind without a wrong answer."""
    apply: Flag = False
    """Refuse answers below the found threshold from now on. Without it, no answer changes."""
    by: Annotated[str | None, option("light,angle")] = None
    """Also give a promise for each group of the walks' images: by the change of light, by the angle
    to the nearest mapped frame, or by each. The threshold stays one for all."""
    format: Format = None
    camera: CameraOption = None
    mask: MaskOption = None
    poses: PosesOption = None
    """Convention of the true poses if it is not world_from_cam in metres."""
    json: File = None
    """Write certificate and answers as JSON to this file (- for standard output)."""
    report: File = None
    """Write a page with the promise, the figures and the blind spots on the plan (HTML)."""
    config: File = None
    """TOML file with the settings of the localizer, as printed by `topoloc config certify`."""

    def run(self) -> int:
        if not 0.0 < self.max_wrong < 100.0:
            raise UsageError(f"--max-wrong must be a percentage, not {self.max_wrong:g}")
        group_by = self._group_by()
        read = [self.map, *self.walk, *self.out_of_map, self.map_from_truth, self.config]
        check_outputs([self.json, self.report], read)
        write_page = _import_page_writer() if self.report else None
        map_from_truth = read_rigid(Path(self.map_from_truth)) if self.map_from_truth else None
        config = read_settings(self.config).get(LocalizerConfig)
        config = with_option(config, "mask", self.mask, "--mask")
        walks, others = ([self._open(one) for one in of] for of in (self.walk, self.out_of_map))
        if self.by and not any(pose for walk in walks for pose in walk.poses):
            raise UsageError("--by groups the images of walks with true poses: add --walk SEQ")
        with progress_bar() as progress:
            found = certify(
                self.map,
                walks,
                others,
                map_from_truth,
                self.max_wrong / 100.0,
                self.apply,
                config,
                progress,
                print_waiting,
                group_by,
            )
        if self.json != "-":
            _print(found)
        write_json(self.json, found.to_json())
        if write_page and self.report:
            with TopoMetricMap.load(self.map) as topomap:
                write_page(Path(self.report), found, topomap, Path(self.map).name)
            if self.json != "-":
                print_line(f"report: {self.report}")
        return 0

    def _group_by(self) -> list[Literal["angle", "light"]]:
        """Return the groups of --by. Raises UsageError: there is no such group."""
        names = self.by.split(",") if self.by else []
        for name in names:
            if name not in ("angle", "light"):
                raise UsageError(f"--by takes light, angle or light,angle, not {name!r}")
        return [name for name in ("light", "angle") if name in names]

    def _open(self, path: str) -> StereoSequence:
        sequence = open_recording(path, self.format, self.camera, whole_only=True)
        has_poses = any(sequence.poses) and path in self.walk
        how = PoseConventions.parse(self.poses)
        return with_pose_conventions(sequence, how) if has_poses else sequence


def _import_page_writer() -> Callable[..., None]:
    with MissingExtraError.on_import("a report needs matplotlib", "report"):
        load_matplotlib()
        from topoloc.apps.report.certificate_page import write_certificate

        return write_certificate


def _print(found: Certification) -> None:
    certificate = found.certificate
    rows = [(one.name, describe_condition(one)) for one in certificate.conditions]
    facts = [("promise", certificate.promise()), *rows]
    facts += map(describe_group, certificate.groups)
    facts.append(("threshold", certificate.describe_threshold()))
    if spots := found.blind_spots:
        where = ", ".join("({:.1f}, {:.1f}, {:.1f})".format(*p.translation) for p in spots[:5])
        facts.append(("blind spots", f"{len(spots)}, at {where}{' ...' if len(spots) > 5 else ''}"))
    facts.append(("limits", describe_limits(certificate)))
    print_fields(facts)
    print_quarters(certificate.quarters)
