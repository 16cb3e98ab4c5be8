"""Compare the size of the code with its budgets: python tools/budgets.py [--write]

Prints a line for each figure more than 3 % above its budget in tools/budgets.json. The exit status
is 0: a budget is a warning, the rules of tests/test_house.py are tests. The figures are those of
tools/house.py: statements a package, public names, bytes of the docs, numbers in function bodies.
A line is also printed for each folder whose docstrings have too many unplain words.

`--write` lowers the budgets to the figures of today. `--allow NAME=VALUE --issue TEXT` sets a
higher one, or one of a new package, and stores the issue that grants it.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import house

ROOT = Path(__file__).resolve().parents[1]
SLACK = 0.03
FROM_HOUSE = ("apps.public_names", "numbers.all", "user_docs_bytes")
PACKAGES = ("worlds", "training", "paper")
FOLDERS = ("src", *PACKAGES, "tests", "benchmarks")
# Plain technical English has at most three of each in 1,000 words.
MAX_RATE = 3.0
WORDS = (
    r"\bwhat\b",
    r"\b(asked|asks|ask|asking|said|says|say|told|tells|tell|speaks?|hears?|heard)\b",
    r"\bwhere\b",
)

Budgets = dict[str, dict[str, Any]]


def measure(root: Path) -> dict[str, int]:
    """Return the value of each figure that has a budget."""
    checkout = house.House(root.resolve(), root)
    counted: dict[str, Any] = {}
    for function in (house.imports, house.numbers, house.pages):
        counted |= dict(function(checkout))
    figures = {name: counted[name] for name in FROM_HOUSE}
    sizes = {n: len(v) if isinstance(v, list | set) else v for n, v in figures.items()}
    return sizes | statements(checkout)


def statements(checkout: house.House) -> dict[str, int]:
    """Return the number of statements of core, of apps, of their packages and of the others."""
    counts: Counter[str] = Counter()
    for path, tree in (checkout.files | checkout.others).items():
        if path in checkout.files:
            names = [checkout.room(path), checkout.room(path)[:4]]
        else:
            names = [n for n in path.relative_to(checkout.root).parts[:1] if n in PACKAGES]
        nodes = (n for n in ast.walk(tree) if isinstance(n, ast.stmt) and not house.is_bare(n))
        size = sum(1 for _ in nodes)
        counts.update({f"statements.{name}": size for name in names})
    return dict(counts)


def word_rate(folder: Path) -> float:
    """Return how often 1,000 words of docstrings have the most frequent of the three habits."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    trees = (house.parsed(path) for path in folder.rglob("*.py"))
    nodes = (node for tree in trees if tree for node in ast.walk(tree) if isinstance(node, kinds))
    text = re.sub(r"`[^`]*`", "X", "\n\n".join(ast.get_docstring(node) or "" for node in nodes))
    num_words = len(re.findall(r"[A-Za-z']+", text))
    most = max(len(re.findall(habit, text, re.IGNORECASE)) for habit in WORDS)
    return round(1000 * most / max(num_words, 1), 1)


def exceeded(figures: Mapping[str, float], budgets: Budgets) -> list[str]:
    """Return a line for each figure more than 3 % above its budget, or without one."""
    lines = []
    for name, value in sorted(figures.items()):
        budget = budgets.get(name, {}).get("budget")
        if budget is None:
            lines.append(f"{name}: {value}, no budget")
        elif value > budget * (1 + SLACK):
            lines.append(f"{name}: {value}, budget {budget}")
    return lines


def lowered(figures: Mapping[str, int], budgets: Budgets) -> Budgets:
    """Return the budgets, none above its figure, without those whose figure is gone."""
    return {
        name: entry | {"budget": min(entry["budget"], figures[name])}
        for name, entry in budgets.items()
        if name in figures
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout")
    parser.add_argument("--write", action="store_true", help="lower the budgets to the figures")
    parser.add_argument("--allow", metavar="NAME=VALUE", help="set one budget; needs --issue")
    parser.add_argument("--issue", metavar="TEXT", help="the issue that grants it")
    options = parser.parse_args()
    name, _, value = (options.allow or "").partition("=")
    figures, path = measure(options.root), options.root / "tools" / "budgets.json"
    budgets: Budgets = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if bool(options.allow) != bool(options.issue):
        parser.error("--allow NAME=VALUE and --issue TEXT need each other")
    if options.allow and (name not in figures or not re.fullmatch(r"\d+", value)):
        parser.error(f"--allow {options.allow}: NAME is one of {', '.join(sorted(figures))}")
    if options.write:
        first: Budgets = {name: {"budget": value} for name, value in figures.items()}
        budgets = lowered(figures, budgets or first)
    if options.allow:
        budgets[name] = {"budget": int(value), "issue": options.issue}
    if options.write or options.allow:
        path.write_text(json.dumps(budgets, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    rates = {f"words.{folder}": word_rate(options.root / folder) for folder in FOLDERS}
    most: Budgets = {folder: {"budget": MAX_RATE} for folder in rates}
    for line in exceeded(figures, budgets) + exceeded(rates, most):
        print(f"warning: over budget: {line}", file=sys.stderr)


if __name__ == "__main__":
    main()
