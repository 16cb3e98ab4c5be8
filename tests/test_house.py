"""The house rules that a machine can hold: floors, sizes, docstrings, a test for every step."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parents[1]
SRC = ROOT / "src" / "topoloc"
TESTS = ROOT / "tests"

PACKAGES = {
    SRC: TESTS,
    ROOT / "worlds" / "src" / "topoloc_worlds": TESTS / "worlds",
    ROOT / "training" / "src" / "topoloc_training": TESTS / "training",
    ROOT / "paper" / "src" / "topoloc_paper": TESTS / "paper",
}
MODULES = sorted(
    path for package in PACKAGES for path in package.rglob("*.py") if path.stat().st_size > 0
)
TEST_FILES = sorted(TESTS.rglob("*.py"))


# The figures of `python tools/house.py .` (`--help` has the rule of each) that have a rule. Sizes
# have budgets instead (tools/budgets.py): one line more turns no test red.
AT_MOST = {"circles": 0, "apps.deep_names": 0, "readme_lines": 150, "architecture_lines": 170}
AT_LEAST = {"documented %": 90, "typed %": 95}
MAX_FILE_LINES, MAX_FUNCTION_LINES = 400, 60  # of a function without its docstring
# Modules of topoloc, and how many of OpenCV, Numba, torch, FAISS and ONNX Runtime, that are loaded
# in a fresh process after an import.
REACH = {
    "localizer": (82, 3),  # goal 60
    "result": (10, 0),  # goal 10, 0
    "map": (21, 0),  # goal 20
    "client": (11, 0),  # goal 10, 0
}


def _relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def _house(*arguments: str) -> dict[str, float]:
    """Return the figures that tools/house.py prints."""
    command = [sys.executable, str(ROOT / "tools" / "house.py"), str(ROOT), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = [line.rsplit(maxsplit=1) for line in done.stdout.splitlines()]
    return {row[0].strip(): float(row[1]) for row in rows if len(row) == 2}


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    path = tmp_path_factory.mktemp("house") / "figures.json"
    _house("--json", str(path))
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", AT_MOST)
def test_figures_are_at_most(figures: dict[str, float], name: str):
    assert figures[name] <= AT_MOST[name]


@pytest.mark.parametrize("name", AT_LEAST)
def test_figures_are_at_least(figures: dict[str, float], name: str):
    assert figures[name] >= AT_LEAST[name]


@pytest.mark.parametrize("name", REACH)
def test_imports_load_few_modules(name: str, tmp_path: Path):
    """`tools/house.py` reads sys.modules of a fresh process."""
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import house  # pyright: ignore[reportMissingImports]
    finally:
        sys.path.pop(0)
    figures = dict(house.reach(house.House(ROOT, tmp_path), name, house.REACHED[name]))
    max_modules, max_heavy = REACH[name]
    assert len(figures[f"reach.{name}"]) <= max_modules
    assert len(figures[f"heavy.{name}"]) <= max_heavy


def test_imports_go_down_only(capsys: pytest.CaptureFixture[str]):
    status = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_files_and_functions_stay_small():
    long: list[str] = []
    for path in (*MODULES, *TEST_FILES):
        num_lines = len(path.read_text(encoding="utf-8").splitlines())
        long += [f"{_relative(path)}: {num_lines} lines"] * (num_lines > MAX_FILE_LINES)
        for node in ast.walk(_tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[ast.get_docstring(node) is not None :] or node.body
                num_lines = (body[-1].end_lineno or 0) - body[0].lineno + 1
                row = f"{_relative(path)}: {node.name} has {num_lines} lines"
                long += [row] * (num_lines > MAX_FUNCTION_LINES)
    assert long == []


def test_every_module_says_what_it_is():
    silent = [_relative(path) for path in MODULES if not ast.get_docstring(_tree(path))]
    assert silent == []


def test_every_module_is_tested():
    """A module that neither has a test file nor serves one that has is named in a warning; a whole
    floor without is a failure."""
    of = {path: package for package in PACKAGES for path in package.rglob("*.py")}
    mirrored = {
        path
        for path in MODULES
        if (
            PACKAGES[of[path]] / path.relative_to(of[path]).parent / f"test_{path.stem}.py"
        ).is_file()
    }
    readers = "\n".join(path.read_text(encoding="utf-8") for path in (*TEST_FILES, *mirrored))
    served = {
        path
        for path in MODULES
        if ".".join(path.relative_to(of[path].parent).with_suffix("").parts) in readers
    }
    untested = [
        _relative(path)
        for path in MODULES
        if path not in mirrored | served and not path.stem.startswith("__")
    ]
    if untested:
        warnings.warn(
            "neither a test file nor used by what has one: " + ", ".join(untested), stacklevel=1
        )
    floors = {
        path.relative_to(SRC).parts[0]
        for path in MODULES
        if path.is_relative_to(SRC) and path.parent != SRC
    }
    assert {floor for floor in floors if not list((TESTS / floor).rglob("test_*.py"))} == set()
