"""Run tools/budgets.py on a small checkout: warnings, lower budgets, granted budgets."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "tools" / "budgets.py"
CORE = "statements.core"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Write a package of forty statements, its pages, and budgets equal to its figures."""
    for folder in ("src/topoloc/slam", "docs", "tools", "worlds"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "README.md").write_text("a page\n")
    (tmp_path / "docs" / "architecture.md").write_text("a page\n")
    write_statements(tmp_path, 40)
    assert run(tmp_path, "--write") == []
    return tmp_path


def write_statements(root: Path, number: int) -> None:
    (root / "src" / "topoloc" / "slam" / "steps.py").write_text("a = 1\n" * number)


def run(root: Path, *words: str, status: int = 0) -> list[str]:
    """Return the lines that the script prints."""
    command = [sys.executable, str(SCRIPT), "--root", str(root), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    return done.stderr.splitlines()


def budget(root: Path, name: str = CORE) -> dict[str, object]:
    return json.loads((root / "tools" / "budgets.json").read_text())[name]


def test_three_percent_more_are_no_warning(checkout: Path):
    write_statements(checkout, 41)
    assert run(checkout) == []
    write_statements(checkout, 42)
    assert run(checkout) == [
        "warning: over budget: statements.core: 42, budget 40",
        "warning: over budget: statements.core/slam: 42, budget 40",
    ]


def test_budgets_are_rewritten_only_downwards(checkout: Path):
    write_statements(checkout, 50)
    run(checkout, "--write")
    assert budget(checkout) == {"budget": 40}
    write_statements(checkout, 30)
    run(checkout, "--write")
    assert budget(checkout) == {"budget": 30}


def test_an_issue_grants_a_higher_budget(checkout: Path):
    write_statements(checkout, 50)
    lines = run(checkout, "--allow", f"{CORE}=50", "--issue", "phones, step 3")
    assert budget(checkout) == {"budget": 50, "issue": "phones, step 3"}
    assert lines == ["warning: over budget: statements.core/slam: 50, budget 40"]


@pytest.mark.parametrize("words", [["--allow", f"{CORE}=50"], ["--issue", "phones"]])
def test_a_higher_budget_needs_its_issue(checkout: Path, words: list[str]):
    assert "need each other" in run(checkout, *words, status=2)[-1]
    assert budget(checkout) == {"budget": 40}


def test_a_new_package_has_no_budget_and_a_removed_one_loses_it(checkout: Path):
    folder = checkout / "src" / "topoloc" / "slam"
    folder.rename(folder.with_name("tracking"))
    assert run(checkout) == ["warning: over budget: statements.core/tracking: 40, no budget"]
    run(checkout, "--write")
    assert "statements.core/slam" not in (checkout / "tools" / "budgets.json").read_text()


def test_unplain_words_are_counted_in_docstrings_alone(checkout: Path):
    path = checkout / "worlds" / "room.py"
    path.write_text(f'"""{"Return the walls. " * 100}"""\nwhat = "what"  # what\n')
    assert run(checkout, "--write") != []
    path.write_text(f'"""{"Return what a wall is. " * 100}"""\n')
    assert "warning: over budget: words.worlds: 200.0, budget 3.0" in run(checkout)
