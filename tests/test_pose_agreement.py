"""Search the source for duplicates: only `Rigid3.is_same` may decide if two poses are equal, and
only `geometry/transform_consensus.py` may search for the consensus of transforms."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src" / "topoloc"
PREDICATE, ENGINE = "geometry/rigid.py", "geometry/transform_consensus.py"
OTHER_TESTS = {
    "tracking/motion.py:_is_same_motion",  # hypotheses of a pose and a velocity
    "apps/formats/bags/bag_poses.py:_interpolate_correction",  # a jump between two times
}
# It draws triples of points. `find_least_median` compares their transforms.
OTHER_ENGINES = {
    "apps/georeferencing/georeference_fit.py:_robust_weights",
    "tracking/gyroscope.py:find_start",  # it calls find_least_median
    "apps/reconstruction/gnss.py:_fit_robustly",  # a similarity, by least median of squares
    "apps/cli/maps/floor.py:_sample_normal",  # it searches a plane, no transform
}
_ORDERS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
_SUMS = {"sum", "count_nonzero"}


def _functions(source: str) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))


def _called(tree: ast.AST) -> set[str]:
    """Return the names of all functions and methods that are called."""
    calls = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
    return {getattr(called, "attr", getattr(called, "id", "")) for called in calls}


def _names(tree: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _is_distance(tree: ast.AST) -> bool:
    has_translation = any(
        isinstance(node, ast.Attribute) and node.attr == "translation" for node in ast.walk(tree)
    )
    return "translation_error" in _called(tree) or (has_translation and "norm" in _called(tree))


def _is_rotation(tree: ast.AST) -> bool:
    return bool({"angle", "rotation_error"} & _called(tree))


def _is_mahalanobis(tree: ast.AST) -> bool:
    return bool({"squared_distance", "solve"} & _called(tree))


def _has_logarithm(tree: ast.AST) -> bool:
    """Return whether `.log()` of a transform is called. Logarithms of numbers have an argument."""
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and not node.args)
    return any(getattr(node.func, "attr", "") == "log" for node in calls)


def _compares(function: ast.FunctionDef, is_measure: Callable[[ast.AST], bool]) -> bool:
    """Return whether a value of this measure, or a variable made from one, is compared."""
    measured = set[str]()
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and is_measure(node.value):
            measured |= set[str]().union(*map(_names, node.targets))
    return any(
        isinstance(node, ast.Compare)
        and isinstance(node.ops[0], _ORDERS)
        and (is_measure(node) or bool(_names(node) & measured))
        for node in ast.walk(function)
    )


def _is_pose_test(function: ast.FunctionDef) -> bool:
    if _compares(function, _is_distance) and _compares(function, _is_rotation):
        return True
    is_of_poses = _has_logarithm(function) or "squared_distance" in _called(function)
    return is_of_poses and _compares(function, _is_mahalanobis)


def _is_engine(function: ast.FunctionDef) -> bool:
    """Return whether a function draws samples in a loop, minimizes a median, or selects the row
    with the largest sum."""
    for node in ast.walk(function):
        called = _called(node)
        if isinstance(node, (ast.For, ast.GeneratorExp, ast.ListComp)):
            if {"choice", "integers"} & called or _compares_sums(node):
                return True
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if (name == "argmax" and _SUMS & called) or (name == "min" and "median" in called):
                return True
    return False


def _compares_sums(tree: ast.AST) -> bool:
    compared = (node for node in ast.walk(tree) if isinstance(node, ast.Compare))
    return any(
        isinstance(node.ops[0], _ORDERS)
        and all(_SUMS & _called(side) for side in (node.left, *node.comparators))
        for node in compared
    )


def _found(check: Callable[[ast.FunctionDef], bool], but: str) -> set[str]:
    modules = ((path, path.relative_to(SRC).as_posix()) for path in SRC.rglob("*.py"))
    return {
        f"{name}:{function.name}"
        for path, name in modules
        if name != but
        for function in _functions(path.read_text(encoding="utf-8"))
        if check(function)
    }


def test_one_predicate_compares_poses():
    assert _found(_is_pose_test, PREDICATE) == OTHER_TESTS


def test_one_engine_searches_for_transforms():
    assert _found(_is_engine, ENGINE) == OTHER_ENGINES


@pytest.mark.parametrize(
    "body",
    [
        "return np.linalg.norm(a.translation - b.translation) < 1.0 and (a @ b).angle() < 0.1",
        "off = a.inverse() @ b; d = np.linalg.norm(off.translation); r = off.angle()\n"
        "    return d < 1.0 and np.degrees(r) < 2.0",
        "return translation_error(a, b) <= 1.0 and rotation_error(a, b) <= 0.1",
        "e = (a.inverse() @ b).log()\n    return e @ np.linalg.solve(c, e) < 12.6",
        "return a.squared_distance(b, c) < 12.6",
    ],
)
def test_another_predicate_would_be_found(body: str):
    assert _is_pose_test(next(_functions(f"def f(a, b, c):\n    {body}\n")))


@pytest.mark.parametrize(
    "body",
    [
        "for _ in range(9):\n        rows = rng.choice(9, 3)",
        "return min(a, key=lambda one: np.median(errors(one)))",
        "return a[np.argmax(a.sum(axis=1))]",
        "for one in a:\n        best = one if one.sum() > best.sum() else best",
    ],
)
def test_another_engine_would_be_found(body: str):
    assert _is_engine(next(_functions(f"def f(a, rng, best):\n    {body}\n")))
