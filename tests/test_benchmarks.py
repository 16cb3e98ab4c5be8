"""Benchmarks import names that exist. Most of them run too long for a test."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
FILES = sorted(BENCHMARKS.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(BENCHMARKS)) for path in FILES])
def test_a_benchmark_imports_names_that_exist(path: Path):
    missing = list[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("topoloc"):
            module = importlib.import_module(str(node.module))
            for name in (one.name for one in node.names):
                if not hasattr(module, name):
                    try:
                        importlib.import_module(f"{node.module}.{name}")
                    except ImportError:
                        missing.append(f"{node.module}.{name}")
    assert missing == []


def test_folders_of_tests_that_benchmarks_use_exist():
    for path in FILES:
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("TESTS = "):
                parts = [part.strip(' "') for part in line.split("/")[1:]]
                assert (BENCHMARKS.parent / Path(*parts)).is_dir(), f"{path.name}: {line}"
