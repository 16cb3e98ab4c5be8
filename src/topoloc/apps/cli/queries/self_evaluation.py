"""`topoloc evaluate MAP --against-itself`: evaluate a map without a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from topoloc import LocalizerConfig, MissingExtraError, WeakRegions, find_weak_regions
from topoloc.apps.cli.features_option import open_localizer
from topoloc.apps.cli.output import (
    UsageError,
    check_outputs,
    print_fields,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.settings_file import read_settings, with_option
from topoloc.apps.report.plotting import load_matplotlib


def evaluate_map_itself(
    path: str,
    coarse: str | None,
    features: str | None,
    outputs: Mapping[str, str | None],
    config: str | None,
) -> int:
    """Print the weak parts of a map and the place of the next recording, and write the files that
    `outputs` names: json, report. Raises UsageError: an atlas has several tiles, or an output would
    replace an input; TopolocError: the map cannot be read, or a file cannot be written."""
    check_outputs(list(outputs.values()), [path, config])
    localizer_config = read_settings(config).get(LocalizerConfig)
    localizer_config = with_option(localizer_config, "coarse", coarse, "--coarse")
    json, report = outputs["json"], outputs["report"]
    write_page = _import_page_writer() if report else None
    localizer = open_localizer(path, localizer_config, features)
    if len(localizer.tile_ids) > 1:
        raise UsageError("--against-itself evaluates one map: name the file of the tile")
    with localizer.in_tile() as in_tile:
        topomap = in_tile.topomap
        info = topomap.describe(topomap.file.path if topomap.file else path)
        with progress_bar() as progress:
            weak = find_weak_regions(in_tile, progress)
        if json != "-":
            _print(weak)
        write_json(json, {"map": info, "against_itself": weak.to_json()})
        if write_page and report:
            write_page(Path(report), weak, topomap, info)
            if json != "-":
                print(f"report: {report}")
    return 0


def _import_page_writer() -> Callable[..., None]:
    with MissingExtraError.on_import("a report needs matplotlib", "report"):
        load_matplotlib()
        from topoloc.apps.report.weak_regions_page import write_weak_regions

        return write_weak_regions


def _print(weak: WeakRegions) -> None:
    of, num_asked = len(weak.nodes), len(weak.queried_nodes)
    held = f"{num_asked - weak.count('not_held')} of {num_asked} nodes, each asked without itself"
    facts = [("held by the rest", held)]
    if weak.weakest and (least := weak.weakest[0]).answer is not None:
        named = f"node {least.node_id} ({least.name})"
        facts.append(("the weakest", f"{named}, {least.answer.num_inliers} inliers"))
    facts.append(("few landmarks", f"{weak.count('few_landmarks')} of {of}"))
    facts.append(("nobody looks back", f"{weak.count('one_direction')} of {of}"))
    sessions = f"{len(weak.session_names)} session{'s' if len(weak.session_names) > 1 else ''}"
    facts.append(("one session alone", f"{weak.count('single_session')} of {of}, of {sessions}"))
    facts.append(("where to walk next", weak.suggest_next_recording()))
    print_fields(facts)
