"""Test `topoloc config`, `--config FILE` on each command with settings, and readable help."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc.apps.cli import all_commands, main
from topoloc.apps.cli.settings_file import all_tables, config_class, read_settings
from topoloc.errors import ConfigError
from topoloc.mapping.topomap import TopoMetricMap

Complaint = Callable[..., str]
FileOf = Callable[[str], str]
MAX_OPTIONS, MAX_LINES = 25, 80


def test_the_output_of_config_is_read_back_as_the_defaults(
    capsys: pytest.CaptureFixture[str], file_of: FileOf
):
    assert main(["config"]) == 0
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 120
    tables = tomllib.loads(printed)
    assert list(tables) == list(all_tables())
    read = read_settings(file_of(printed))
    for name in all_tables():
        assert tables[name]
        assert read.get(config_class(name)) == config_class(name)()


def test_a_command_can_be_named(capsys: pytest.CaptureFixture[str]):
    assert main(["config", "evaluate"]) == 0
    assert list(tomllib.loads(capsys.readouterr().out)) == [
        "localize",
        "atlas",
        "cluster",
    ]
    assert main(["config", "build"]) == 0
    assert list(tomllib.loads(capsys.readouterr().out)) == ["build", "cluster"]
    assert main(["config", "train"]) == 0
    assert list(tomllib.loads(capsys.readouterr().out)) == ["train"]


def test_a_table_of_a_distribution_that_is_not_installed_names_it(
    file_of: FileOf, monkeypatch: pytest.MonkeyPatch
):
    path = file_of("train.cnn_fc.label_spread = 0.5")
    assert "train" in all_tables()
    read_settings(path)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    with pytest.raises(
        ConfigError, match=r"train: needs topoloc-training, which is not installed$"
    ):
        read_settings(path)


def test_only_commands_with_settings_can_be_named(complaint: Complaint):
    assert "info has no settings beside its options; build, " in complaint(
        "config", "info", status=2
    )
    assert "biuld" in complaint("config", "biuld", status=2)


@pytest.mark.parametrize("command", all_commands())
@pytest.mark.parametrize("columns", ["80", "140"])
def test_help_is_short(
    command: str, columns: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit):
        main([command, "--help"])
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) <= MAX_LINES
    assert len(re.findall(r"^\W*--[a-z]|, --help", printed, re.MULTILINE)) <= MAX_OPTIONS
    assert "--config." not in printed
    reads = [name for name, (_, _, commands) in all_tables().items() if command in commands]
    assert ("--config FILE" in printed) == bool(reads)
    assert "(default: False)" not in printed


def test_options_and_file_reach_the_map_and_options_win(
    tiny_recording: Path, tmp_path: Path, file_of: FileOf
):
    path, info = tmp_path / "room.topo", tmp_path / "info.json"
    content = (
        "[build]\nvlad.num_words = 8\nsides.spacing = 0\nnodes = {d_thresh = 9, lambda_rot ="
        " 0.5}\n[localize]\nnum_candidates = 1"
    )
    options = ["--config", file_of(content), "--lambda", "0.25", "--json", str(info)]
    assert main(["build", f"{tiny_recording}@0:6", str(path), *options]) == 0
    config = json.loads(info.read_text())["config"]
    assert config["nodes"] == {"d_thresh": 9.0, "lambda_rot": 0.25}
    assert (config["vlad"]["num_words"], config["sides"]["spacing"]) == (8, 0.0)
    topomap = TopoMetricMap.load(path)
    assert topomap.sides is None


def test_settings_reach_the_queries_and_their_stream(
    room_map: Path, tiny_recording: Path, queries: Path, tmp_path: Path, file_of: FileOf
):
    results, path = (
        tmp_path / "a.json",
        file_of('[localize]\nnum_candidates = 2\n[track]\nmode = "paper"\nmax_jump = 1e-6\n'),
    )
    assert (
        main(["localize", str(room_map), str(queries), "--config", path, "--json", str(results)])
        == 0
    )
    answers = [json.loads(line) for line in results.read_text().splitlines()]
    assert {len(answer["candidates"]) for answer in answers} == {2}
    assert (
        main(
            [
                "localize",
                str(room_map),
                f"{tiny_recording}@0:3",
                "--config",
                path,
                "--json",
                str(results),
            ]
        )
        == 0
    )
    assert [json.loads(line).get("reason") for line in results.read_text().splitlines()] == [
        None,
        "jump",
        "jump",
    ]


def test_bad_settings_are_one_line_before_the_work(
    room_map: Path, tiny_recording: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    def refused(text: str, *command: object) -> str:
        (tmp_path / "my.toml").write_text(text)
        return complaint(*command, "--config", tmp_path / "my.toml")

    build = ("build", tiny_recording, tmp_path / "a.topo")
    for number in ("-1", "0", "nan", "inf"):
        assert "--d-thresh: must be " in complaint(*build, "--d-thresh", number, status=2)
        assert "my.toml: build.nodes.d_thresh: must be " in refused(
            f"[build]\nnodes.d_thresh = {number}", *build
        )
    assert "--lambda: must be " in complaint(*build, "--lambda", "-1", status=2)
    assert "--max-jump: must be " in complaint(
        "localize", room_map, queries, "--max-jump", "nan", status=2
    )
    assert "localize.num_candidates: must be " in refused(
        "[localize]\nnum_candidates = 0", "localize", room_map, queries
    )
    assert (
        "localize.num_candidate: no such setting; did you mean localize.num_candidates?"
        in refused("localize.num_candidate = 1", "evaluate", room_map, queries)
    )
    assert "slam: no such table" in refused("slam.odometry.windows = 15", *build)
    assert "train.cnn_fc.training.held_out: must be " in refused(
        "train.cnn_fc.training.held_out = 1", "train", room_map, "--coarse", "cnn-fc"
    )
    (tmp_path / "my.toml").write_text("")
    assert "used twice" in complaint(
        "build", tiny_recording, tmp_path / "my.toml", "--config", tmp_path / "my.toml"
    )


def test_removed_settings_are_named_in_one_line(
    tiny_recording: Path, tmp_path: Path, file_of: FileOf, capsys: pytest.CaptureFixture[str]
):
    old = file_of(
        "[build]\nmax_node_points = 800\nmin_node_points = 30\n[slam.loops]\nmax_drift = 1"
    )
    assert main(["build", f"{tiny_recording}@0:6", str(tmp_path / "a.topo"), "--config", old]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "no longer" in line]
    assert lines == [
        f"warning: {old}: no longer settings, without effect: build.min_node_points,"
        " slam.loops.max_drift"
    ]
