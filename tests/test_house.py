"""The house rules that a machine can hold: floors, sizes, docstrings, a test for every step."""

from __future__ import annotations

import ast
import warnings
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parents[1]
SRC = ROOT / "src" / "topoloc"
TESTS = ROOT / "tests"
# Beyond these a missing idea is likely and a warning is given; at half as much again it is certain.
MAX_FILE_LINES, MAX_FUNCTION_LINES = 300, 60
HARD_LIMIT = 1.5

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


def _relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def test_imports_go_down_only(capsys: pytest.CaptureFixture[str]):
    status = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_files_and_functions_stay_small():
    sizes: list[tuple[float, str]] = []
    for path in (*MODULES, *TEST_FILES):
        num_lines = len(path.read_text(encoding="utf-8").splitlines())
        sizes.append((num_lines / MAX_FILE_LINES, f"{_relative(path)}: {num_lines} lines"))
        for node in ast.walk(_tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                num_lines = node.end_lineno - node.lineno + 1
                sizes.append(
                    (
                        num_lines / MAX_FUNCTION_LINES,
                        f"{_relative(path)}: {node.name} has {num_lines} lines",
                    )
                )
    if long := [text for share, text in sizes if share > 1]:
        warnings.warn("a missing idea? " + "; ".join(long), stacklevel=1)
    assert [text for share, text in sizes if share > HARD_LIMIT] == []


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
    assert {floor for floor in floors if not list((TESTS / floor).glob("test_*.py"))} == set()
