"""Check the documentation against the code: commands, settings, result keys, tables and public
names, no more and no less."""

from __future__ import annotations

import importlib
import re
import sqlite3
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest

import topoloc
import topoloc.plugin
from topoloc.apps.cli import all_commands, main
from topoloc.evaluation.metrics import EvaluatedQuery, summarize
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import CandidateNode, Localization, NotLocalized, Reason
from topoloc.mapping.storage import schema

DOORS = (topoloc, topoloc.plugin)
ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CLI = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
RESULTS = (ROOT / "docs" / "results-and-exports.md").read_text(encoding="utf-8")
MAP_FORMAT = (ROOT / "docs" / "map-format.md").read_text(encoding="utf-8")
PLAN = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
JOURNAL = sorted((ROOT / "docs" / "journal").glob("*.md"))

LOCALIZED = Localization(
    Rigid3.identity(), np.eye(6), 1.0, 0, [CandidateNode(0, 1.0)], 30, 20, {"total": 1.0}
)
UNREADABLE = NotLocalized("unreadable", detail="which file, and why")


def _section(page: str, title: str) -> str:
    """Return the section of a page below a heading of the second level."""
    match = re.search(rf"^## {title}$(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    assert match, f"no section '## {title}'"
    return match.group(1)


def _settings(command: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    """Return the settings that `topoloc COMMAND --help` lists."""
    with pytest.raises(SystemExit):
        main([command, "--help"])
    return set(re.findall(r"^\W*(--[a-z][\w.-]*)", capsys.readouterr().out, re.MULTILINE))


def _code_blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("command", all_commands())
def test_every_command_and_setting_is_in_the_docs(command: str, capsys: pytest.CaptureFixture[str]):
    assert f"topoloc {command}" in README
    settings = _settings(command, capsys)
    documented = set(re.findall(r"`(--[a-z][\w-]*)", _section(CLI, f"topoloc {command}")))
    assert settings - documented == set()
    assert documented - settings == set(), "documented, but no setting of this command"


def test_commands_in_code_blocks_exist(capsys: pytest.CaptureFixture[str]):
    settings = {command: _settings(command, capsys) for command in all_commands()}
    lines = [
        line
        for page in PAGES
        for block in _code_blocks(page.read_text(encoding="utf-8"), "(?:sh|bash)")
        for line in block.splitlines()
    ]
    calls = [line for line in lines if re.match(r"(?:\S*/)?topoloc ", line)]
    assert len(calls) >= len(all_commands())
    for call in calls:
        command, *words = call.partition("#")[0].split()[1:]
        if command.startswith("--"):
            continue
        assert command in all_commands(), call
        used = {word.partition("=")[0] for word in words if word.startswith("--")}
        assert used <= settings[command] | {"--help"}, call


@pytest.mark.parametrize("reason", get_args(Reason))
def test_every_reason_is_documented(reason: str):
    assert f"`{reason}`" in _section(RESULTS, "Results")


def test_result_and_evaluation_keys_are_documented():
    for key in {**LOCALIZED.to_json("a.png"), **UNREADABLE.to_json("b.png")}:
        assert f'"{key}"' in _section(RESULTS, "Results")
    answers = [
        EvaluatedQuery("a.png", LOCALIZED, Rigid3.identity(), 0),
        EvaluatedQuery("b.png", UNREADABLE, None),
    ]
    evaluation = summarize(answers)
    for key in (*evaluation, *evaluation["recall"]):
        assert f'"{key}"' in _section(RESULTS, "Evaluations")


def test_every_table_and_column_of_the_map_is_documented():
    with closing(sqlite3.connect(":memory:")) as database:
        for table in schema.TABLES:
            database.execute(schema.create_table_statement(table))
        tables = [
            name
            for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        ]
        for table in tables:
            (section,) = re.findall(
                rf"^### {table}$(.*?)(?=^##|\Z)", MAP_FORMAT, re.MULTILINE | re.DOTALL
            )
            columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
            assert [column for column in columns if f"`{column}`" not in section] == []
    assert set(re.findall(r"^### (\w+)$", MAP_FORMAT, re.MULTILINE)) == set(tables)
    assert f"schema version is {schema.SCHEMA_VERSION}" in MAP_FORMAT
    assert f"0x{schema.APPLICATION_ID:08X}" in MAP_FORMAT


@pytest.mark.parametrize(
    ("door", "name"),
    [(door, name) for door in DOORS for name in door.__all__ if name != "__version__"],
)
def test_every_public_name_is_documented(door: ModuleType, name: str):
    public = getattr(door, name)
    assert public.__doc__
    assert not public.__doc__.startswith(f"{name}("), (
        "the words that a dataclass is given where it has none of its own"
    )


def test_python_examples_compile_and_use_public_names():
    blocks = [
        block
        for page in PAGES
        for block in _code_blocks(page.read_text(encoding="utf-8"), "python")
    ]
    assert blocks
    for block in blocks:
        compile(block, "example", "exec")
        for module, names in re.findall(
            r"^from (topoloc\.[\w.]+) import ([\w, ]+)$", block, re.MULTILINE
        ):
            assert [
                name
                for name in names.split(", ")
                if not hasattr(importlib.import_module(module), name)
            ] == []
        assert set(re.findall(r"(?<!from )\btopoloc\.(\w+)", block)) <= set(topoloc.__all__)


def test_every_path_that_the_plan_names_exists():
    """Resolve paths in the plan against the package, or else against the repository."""
    named = re.findall(r"`([\w./-]+(?:/[\w.-]*|\.(?:py|md|toml)))`", PLAN)
    assert len(named) > 40
    places = (ROOT / "src" / "topoloc", ROOT)
    assert [path for path in named if not any((at / path).exists() for at in places)] == []


def test_every_package_is_in_the_table_of_layers():
    package = ROOT / "src" / "topoloc"
    table = re.search(r"^## Layers\n(.*?)^## ", PLAN, re.MULTILINE | re.DOTALL)
    assert table
    rows = [row for row in table.group(1).splitlines() if row.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`(\w+)(?:/|\.py)`", row.split("|")[1])}
    there = {path.parent.name for path in package.glob("*/__init__.py")}
    there |= {path.stem for path in package.glob("*.py") if not path.stem.startswith("__")}
    assert named == there
    applications = {path.parent.name for path in package.glob("apps/*/__init__.py")}
    assert set(re.findall(r"`apps/(\w+)`", table.group(1))) == applications


def test_every_name_in_the_plan_is_defined_in_the_file_beside_it():
    rows = re.findall(
        r"^\| ((?:`\w+`(?:, )?)+) \| ((?:`[\w/]+\.py`(?:, )?)+) \|", PLAN, re.MULTILINE
    )
    assert len(rows) >= 9
    for names, paths in rows:
        text = "".join(
            (ROOT / "src" / "topoloc" / path).read_text(encoding="utf-8")
            for path in re.findall(r"`([^`]+)`", paths)
        )
        for name in re.findall(r"`(\w+)`", names):
            assert re.search(
                rf"^(?:class|def) {name}\b|^{name}(?:: [^=]+)? = ", text, re.MULTILINE
            ), name


def _is_importable(name: str) -> bool:
    """Return whether a dotted name is a module, or an attribute of one."""
    module, _, attribute = name.rpartition(".")
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        return bool(module) and hasattr(importlib.import_module(module), attribute)
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_dotted_names_that_a_page_mentions_exist(page: Path):
    """Check names such as `topoloc.lifelong.merge.merge_maps`, but not groups of entry points."""
    groups = {"topoloc.commands", "topoloc.settings", "topoloc.coarse_localizers"}
    named = set(re.findall(r"`(topoloc(?:\.[A-Za-z_]\w*)+)`", page.read_text(encoding="utf-8")))
    assert [name for name in sorted(named - groups) if not _is_importable(name)] == []


@pytest.mark.parametrize("page", [*PAGES, *JOURNAL], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path):
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    local = [link for link in links if "://" not in link]
    assert [link for link in local if not (page.parent / link).exists()] == []


def _read_variables() -> set[str]:
    """Return the environment variables that the four distributions read, set or name."""
    named = (
        r"[\"'$](TOPOLOC_[A-Z_]+|NUMBA_[A-Z_]+|RAY_AUTH_[A-Z_]+|DRJIT_[A-Z_]+|[A-Z_]*NUM_THREADS)"
    )
    read = r"(?:environ(?:\.(?:get|setdefault|pop))?|getenv)[(\[]\s*\"([A-Z_]+)\""
    folders = ("src", "worlds/src", "training/src", "paper/src")
    texts = [one.read_text("utf-8") for at in folders for one in (ROOT / at).rglob("*.py")]
    return {name for text in texts for name in re.findall(read, text) + re.findall(named, text)}


def test_environment_variables_are_in_the_table_and_no_others():
    table = _section(CLI, "Environment variables")
    found = _read_variables() - {"OMP_NUM_THREADS", "MKL_NUM_THREADS", "COLUMNS"}
    assert {"TOPOLOC_CACHE", "TOPOLOC_SHARED", "TOPOLOC_MITSUBA_VARIANT"} <= found
    documented = set(re.findall(r"`([A-Z]+(?:_[A-Z]+)+|TMPDIR)`", table))
    assert found - documented == set()
    texts = "".join(path.read_text("utf-8") for path in ROOT.glob("**/src/**/*.py"))
    assert [name for name in documented if name not in texts] == []
