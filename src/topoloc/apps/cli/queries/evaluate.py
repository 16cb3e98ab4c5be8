"""topoloc evaluate MAP|ATLAS SEQ [SEQ ...], topoloc evaluate MAP --against-itself."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import (
    AtlasConfig,
    EvaluatedQuery,
    Evaluation,
    Localizer,
    LocalizerConfig,
    Rigid3,
    StereoSequence,
    TopoMetricMap,
    TrajectoryError,
)
from topoloc.apps.cli.features_option import QUERY_FEATURES, CoarseOption, open_localizer
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Flag,
    Format,
    MaskOption,
    PosesOption,
    RayOption,
    Topics,
    UsageError,
    check_outputs,
    import_report_writer,
    option,
    print_fields,
    print_line,
    print_quarters,
    print_recordings,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.queries.remote_queries import QueryRecording, RemoteMap, localize_on_ray
from topoloc.apps.cli.queries.self_evaluation import evaluate_map_itself
from topoloc.apps.cli.settings_file import read_settings, with_option
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.core_names import format_length
from topoloc.plugin import decode_json, read_text


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc evaluate`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    sequences: Annotated[tyro.conf.Positional[tuple[str, ...]], option("SEQ ...")] = ()
    """Recordings with true poses. PATH@1::2 selects every second frame of PATH from frame 1 on."""
    tile: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(atlases only)")
    ] = None
    """Tile in whose world the true poses are given. A pose in a tile of another world is a false
    accept."""
    elsewhere: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="SEQ", help_behavior_hint="(may be given several times)"),
    ] = ()
    """A recording of another place. Every pose of one of its images is a false accept."""
    against_itself: Flag = False
    """Find the weak parts of the map without a recording, and the best place to record next. Each
    node is localized in the rest of the map."""
    map_from_truth: File = None
    """JSON file with the 4x4 transform (metres) from the world of the true poses to the map's, if
    they differ."""
    fit_map_from_truth: File = None
    """Write the rigid transform between the two worlds to this file, if one explains the errors.
    --map-from-truth reads it."""
    coarse: CoarseOption = None
    features: QUERY_FEATURES = None
    format: Format = None
    camera: CameraOption = None
    mask: MaskOption = None
    poses: PosesOption = None
    """Convention of the true poses if it is not world_from_cam in metres: inverse, opengl, wxyz,
    mm, as in `build`."""
    topics: Topics = None
    json: File = None
    """Write the evaluation as JSON to this file (- for standard output)."""
    report: File = None
    """Write a page with tables, a plan of the map, error curves and the worst queries to this file
    (HTML)."""
    ray: RayOption = None
    """Ray cluster that localizes the images, with the same results. `auto` is the running cluster
    of this machine, `local` starts one on this machine."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config evaluate`."""

    def run(self) -> int:
        if self.against_itself:
            self._check_no_recordings()
            outputs = {"json": self.json, "report": self.report}
            return evaluate_map_itself(self.map, self.coarse, self.features, outputs, self.config)
        self._check_usage()
        settings = read_settings(self.config)
        config = with_option(settings.get(LocalizerConfig), "coarse", self.coarse, "--coarse")
        config = with_option(config, "mask", self.mask, "--mask")
        localizer = open_localizer(self.map, config, self.features, settings.get(AtlasConfig))
        tile_id = self._select_tile(localizer)
        with localizer.in_tile(tile_id) as in_tile:
            topomap = in_tile.topomap
            topomap.require_scale("an evaluation")
            info = topomap.describe(topomap.file.path if topomap.file else self.map)
        opened = self._open_recordings()
        with progress_bar() as progress:
            if self.ray is None:
                answers = [
                    answer
                    for one, sequence in opened
                    for answer in one.answers(sequence, localizer, tile_id, progress)
                ]
            else:
                sent = RemoteMap.from_localizer(localizer, tile_id, self.features)
                cluster = settings.get(ClusterConfig)
                answers = localize_on_ray(sent, opened, self.ray, cluster, progress)
        self._report(Evaluation(answers), localizer, topomap, info)
        return 0

    def _check_usage(self) -> None:
        if not self.sequences and not self.elsewhere:
            raise UsageError(
                "evaluate takes a map and at least one recording, with truth or --elsewhere, or"
                " --against-itself"
            )
        if self.fit_map_from_truth and (self.map_from_truth or len(self.sequences) != 1):
            raise UsageError("--fit-map-from-truth needs one recording and no --map-from-truth")
        if self.report:
            import_report_writer()
        inputs = [self.map, *self.sequences, *self.elsewhere, self.map_from_truth, self.config]
        check_outputs([self.json, self.report, self.fit_map_from_truth], inputs)

    def _report(
        self,
        evaluated: Evaluation,
        localizer: Localizer,
        topomap: TopoMetricMap,
        info: dict[str, Any],
    ) -> None:
        """Print the figures and write the files that the options name."""
        fits = [fit.to_json() for fit in evaluated.world_fits if len(localizer.tile_ids) == 1]
        evaluation = evaluated.to_json() | {
            "map": info,
            "world_fits": fits,
            "calibrations": evaluated.calibrations(),
        }
        if self.json != "-":
            _print(evaluation)
            print_quarters(evaluated.quarters)
        for fit in fits:
            line = _report_world_fit(fit, self.fit_map_from_truth)
            print_line(line, sys.stderr if self.json == "-" else sys.stdout)
        answers = evaluated.answers
        write_json(self.json, evaluation | {"answers": [answer.to_json() for answer in answers]})
        if self.report:
            import_report_writer()(Path(self.report), evaluation, answers, topomap)
            if self.json != "-":
                print(f"report: {self.report}")
        self._write_fit(fits)

    def _open_recordings(self) -> list[tuple[QueryRecording, StereoSequence]]:
        """Open the recordings, those with true poses first."""
        map_from_truth = read_rigid(Path(self.map_from_truth)) if self.map_from_truth else None
        paths, count = [*self.sequences, *self.elsewhere], len(self.sequences)
        how = (self.format, self.camera, self.topics, self.poses)
        recordings = [
            QueryRecording(path, *how, number >= count, map_from_truth)
            for number, path in enumerate(paths)
        ]
        opened = [(one, one.open()) for one in recordings]
        labels = _unique_labels(paths, [sequence for _, sequence in opened])
        named = zip(opened, labels, strict=True)
        return [(replace(one, label=label), sequence) for (one, sequence), label in named]

    def _check_no_recordings(self) -> None:
        """Refuse options that need a recording."""
        allowed = ("map", "against_itself", "coarse", "features", "json", "report", "config")
        given = [
            "recordings" if one.name == "sequences" else f"--{one.name.replace('_', '-')}"
            for one in fields(self)
            if one.name not in allowed and getattr(self, one.name)
        ]
        if given:
            raise UsageError(f"--against-itself uses the map alone, without {', '.join(given)}")

    def _select_tile(self, localizer: Localizer) -> str:
        """Return the tile in whose world the true poses are. Raises UsageError: there are several,
        and none is named."""
        ids = localizer.tile_ids
        if self.tile is None and len(ids) > 1 and self.sequences:
            raise UsageError("--tile NAME is needed: the tile in whose world the true poses are")
        if len(ids) > 1 and (self.report or self.fit_map_from_truth):
            raise UsageError(
                "--report and --fit-map-from-truth need one map: name the file of the tile"
            )
        return self.tile or ids[0]

    def _write_fit(self, fits: Sequence[dict[str, Any]]) -> None:
        path = self.fit_map_from_truth
        if path and not fits:
            raise TrajectoryError(
                f"{path} is not written: no rigid transform between two worlds explains the errors"
            )
        if path:
            write_json(path, {"map_from_truth": fits[0]["map_from_truth"]})


def _report_world_fit(fit: dict[str, Any], written: str | None) -> str:
    """Return one line: the worlds differ, the errors in one world, and the option that uses it."""
    left = f"{format_length(fit['median_translation_m'])} and {fit['median_rotation_deg']:.2f} deg"
    transform = Rigid3.from_matrix(fit["map_from_truth"])
    distance = format_length(float(np.linalg.norm(transform.translation)))
    apart = f"{distance}, {np.degrees(transform.angle()):.1f} deg"
    how = "--fit-map-from-truth FILE writes that transform, --map-from-truth FILE judges by it"
    how = f"--map-from-truth {written}" if written else how
    return (
        f"{fit['recording']}: its truth is in another world than the map: one rigid transform"
        f" ({apart}) explains {fit['num_answers']} of {fit['num_localized']} answers, median error"
        f" then {left}; {how}"
    )


def _unique_labels(paths: Sequence[str], sequences: Sequence[StereoSequence]) -> list[str]:
    """Return the names of the recordings, or the ends of their paths or the paths, if names are
    equal."""
    choices = ([sequence.name for sequence in sequences], [Path(path).name for path in paths])
    return next((names for names in choices if len(set(names)) == len(names)), list(paths))


def read_rigid(path: Path) -> Rigid3:
    """Read a 4x4 matrix, alone or as the only matrix of a JSON object."""
    data = decode_json(read_text(path, TrajectoryError), Any, TrajectoryError, str(path))
    values = data.values() if isinstance(data, dict) else [data]
    matrices = [value for value in values if isinstance(value, list)]
    if len(matrices) != 1:
        raise TrajectoryError(f"{path}: one 4x4 matrix is needed")
    with TrajectoryError.at(path):
        return Rigid3.from_matrix(matrices[0])


def _print(evaluation: dict[str, Any]) -> None:
    e = evaluation
    if len(e["recordings"]) > 1:
        print_recordings(e)
        print()
    facts = _facts_with_truth(e) if e["num_queries"] else []
    out_of_map = f"of {e['num_elsewhere']} out-of-map images, and " if e["num_elsewhere"] else ""
    limits = f"{EvaluatedQuery.MAX_TRANSLATION} m or {EvaluatedQuery.MAX_ROTATION_DEG:g} deg"
    false = f"{e['false_accepts']} ({out_of_map}of poses off by more than {limits})"
    facts.append(("false accepts", false))
    if e["not_localized"]:
        reasons = [f"{reason} {count}" for reason, count in e["not_localized"].items()]
        facts.append(("not localized", ", ".join(reasons)))
    if left_out := [f"{camera} {count}" for camera, count in e.get("left_out", {}).items()]:
        facts.append(("cameras left out", ", ".join(left_out)))
    times = [f"{stage} {ms:.1f}" for stage, ms in e["median_times_ms"].items()]
    facts.append(("median ms", ", ".join(times)))
    facts += [("calibration", f"{one['recording']}: {one['detail']}") for one in e["calibrations"]]
    of = e["map"]
    size = f"{of['num_nodes']} nodes, {of['bytes'] / 1e6:.2f} MB, {of['length_m']:.1f} m"
    facts.append(("map", size))
    print_fields(facts)


def _facts_with_truth(e: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the figures of queries with a known pose."""
    share = 100 * e["num_localized"] / e["num_queries"]
    facts = [("localized", f"{e['num_localized']} of {e['num_queries']} ({share:.1f} %)")]
    if e["num_localized"]:
        error = f"{100 * e['median_translation_m']:.2f} cm, {e['median_rotation_deg']:.3f} deg"
        largest = f"{100 * e['max_translation_m']:.2f} cm, {e['max_rotation_deg']:.3f} deg"
        facts += [("median error", error), ("largest error", largest)]
        outside = f"{e['num_outside_ellipsoid']} outside their 95 % ellipsoid"
        facts.append(("inaccurate", f"{e['num_inaccurate']} beyond 25 cm or 2 deg, {outside}"))
    recalls = [f"{name.replace('_', ' ')} {100 * one:.1f} %" for name, one in e["recall"].items()]
    facts.append(("recall", ", ".join(recalls)))
    if e["topological_accuracy"] is not None:
        nearest, neighbour = 100 * e["topological_accuracy"], 100 * e["neighbour_accuracy"]
        text = f"{nearest:.1f} %, or a neighbour {neighbour:.1f} %"
        facts.append(("nearest node named first", text))
    return facts
