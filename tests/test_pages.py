"""Test the pages of docs/: scripts, settings and names on them exist, the quickstart runs, and
Sphinx has no warning."""

from __future__ import annotations

import ast
import functools
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import topoloc
import topoloc.plugin
from topoloc.apps.cli import all_commands
from topoloc.apps.cli.settings_file import all_tables, config_class, read_settings

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md")])
SCRIPTS = sorted((ROOT / "benchmarks").glob("*.py"))
SPHINX_PACKAGES = ("sphinx", "furo", "myst_parser")


def _read(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def _run(*command: str | Path, folder: Path) -> str:
    """Run a program with this Python's folder first in PATH, and return its output. It
    must exit with 0."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _marked_blocks(page: str, language: str) -> list[str]:
    """Return the code blocks that a page marks as run by this test."""
    mark = re.escape("<!-- run by tests/test_pages.py -->")
    return re.findall(rf"^{mark}\n```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_every_benchmark_is_on_its_page_with_its_command(script: Path):
    assert f"`python benchmarks/{script.name}" in _read("benchmarks.md")
    docstring = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8")))
    assert docstring
    assert f"python benchmarks/{script.name}" in docstring


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_benchmarks_and_options_that_a_page_names_are_there(page: Path):
    for name, words in re.findall(
        r"\bbenchmarks/(\w+\.py)\b([^`\n|]*)", page.read_text(encoding="utf-8")
    ):
        script = ROOT / "benchmarks" / name
        assert script.is_file(), f"{page.name} names benchmarks/{name}"
        text = script.read_text(encoding="utf-8")
        for option in re.findall(r"--([a-z][a-z-]*)", words):
            assert f"--{option}" in text, f"{page.name}: {name} has no --{option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_targets_of_make_that_a_page_names_are_there(page: Path):
    targets = set(
        re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert (
        set(re.findall(r"(?:^|`)make (\w+)", page.read_text(encoding="utf-8"), re.MULTILINE))
        <= targets
    )


@pytest.mark.parametrize("door", [topoloc, topoloc.plugin], ids=lambda door: door.__name__)
def test_public_names_are_in_the_reference_once_each(door: ModuleType):
    directives = r"autofunction|autoclass|autoexception"
    described = re.findall(
        rf"^\.\. (?:{directives}):: {re.escape(door.__name__)}\.(\w+)$",
        _read("api.md"),
        re.MULTILINE,
    )
    page, _, extensions = _read("api.md").partition("(extensions)=")
    text = extensions if door is topoloc.plugin else page
    described += re.findall(r"^\.\. py:data:: (\w+)$", text, re.MULTILINE)
    assert sorted(described) == sorted(door.__all__)


def test_a_public_name_is_in_one_module():
    assert set(topoloc.__all__) & set(topoloc.plugin.__all__) == set()


def test_settings_that_the_pipeline_names_are_there(capsys: pytest.CaptureFixture[str]):
    """Check the table of the paper's own settings."""
    from topoloc.apps.cli import main

    helps = ""
    for command in ("build", "train", "localize"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        helps += capsys.readouterr().out
    page = _read("pipeline.md")
    options = set(re.findall(r"(--[a-z][\w.-]*)", page))
    assert len(options) > 3
    assert {option for option in options if f"{option} " not in helps} == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_settings_of_files_that_a_page_names_are_there(page: Path, tmp_path: Path):
    """Check lines such as `localize.num_candidates = 1`, keys such as
    `train.vlad_nn.tuning.num_epochs`, and TOML blocks."""
    text, tables = page.read_text(encoding="utf-8"), "|".join(all_tables())
    blocks = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    blocks += re.findall(rf"`((?:{tables})\.[\w.]+ = [^`]+)`", text)
    for block in blocks:
        (tmp_path / "page.toml").write_text(block, encoding="utf-8")
        read_settings(str(tmp_path / "page.toml"))
    for key in re.findall(rf"`((?:{tables})(?:\.\w+)+)`", text):
        table, *names = key.split(".")
        if names[-1] != "py":
            functools.reduce(getattr, names, config_class(table)())
    if page.name == "pipeline.md":
        assert len(blocks) >= 5


def test_every_page_is_reached_from_the_index():
    index = _read("index.md")
    listed = {
        line
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```", index, re.MULTILINE | re.DOTALL)
        for line in block.split()
    }
    assert {page.stem for page in DOCS.glob("*.md")} - {"index"} <= listed


def test_the_quickstart_runs(tmp_path: Path):
    page = _read("quickstart.md")
    (shell,), (python,) = _marked_blocks(page, "sh"), _marked_blocks(page, "python")
    printed = _run("bash", "-euo", "pipefail", "-c", shell, folder=tmp_path)
    assert "8 of 8" in printed
    assert len((tmp_path / "night.jsonl").read_text(encoding="utf-8").splitlines()) == 8
    for name in ("lab.topo", "night.tum", "day-and-night.html"):
        assert (tmp_path / name).stat().st_size > 0
    assert _run(sys.executable, "-c", python, folder=tmp_path).strip()


def test_the_pages_build_without_a_warning(tmp_path: Path):
    missing = [name for name in SPHINX_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed (the extra docs)")
    _run(
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-d",
        tmp_path / "trees",
        DOCS,
        tmp_path / "html",
        folder=ROOT,
    )
    reference, commands = (
        (tmp_path / "html" / f"{name}.html").read_text(encoding="utf-8")
        for name in ("api", "commands")
    )
    assert [name for name in topoloc.__all__ if f'id="topoloc.{name}"' not in reference] == []
    assert [name for name in all_commands() if f"usage: topoloc {name} " not in commands] == []
