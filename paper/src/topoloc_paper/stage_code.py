"""Find the code on which a stage's result depends: its own modules and their imports.

Comments and docstrings do not count, nor do modules whose results are in the stage's settings. So a
change of localization alone repeats all queries, but builds no map, trains no network and runs no
peer. Modules that are imported at run time, by a name in a string, are listed here.
"""

from __future__ import annotations

import ast
import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import topoloc
import topoloc_training

_FILES = {
    "topoloc": topoloc.__file__,
    "topoloc_training": topoloc_training.__file__,
    "topoloc_paper": __file__,
}
# the folder that each package lies in
ROOTS = {name: Path(path).parents[1] for name, path in _FILES.items() if path is not None}
COARSE_MODULES = {
    "surf-vlad": "topoloc/retrieval/vlad.py",
    "cnn-fc": "topoloc_training/cnn_fc.py",
    "cnn-nn": "topoloc_training/cnn_nn.py",
    "vlad-nn": "topoloc_training/vlad_nn.py",
}
_READING = "topoloc/recordings/open.py"
_COUNTING = (
    "topoloc/evaluation/metrics.py",
    "topoloc_paper/settings.py",
)  # what is made of answers, and what is asked for
_NEVER = ("topoloc/errors.py",)  # a stage that fails leaves no result


@dataclass(frozen=True)
class StageCode:
    """`modules` (paths from their package on) with all that they import, directly or not; `apart`
    are those that do not count."""

    modules: tuple[str, ...]
    apart: tuple[str, ...] = ()

    def files(self) -> tuple[str, ...]:
        """The modules that count, in the order of their names."""
        found, waiting = set[str](), list(self.modules)
        while waiting:
            module = waiting.pop()
            if module not in found and not any(
                module == name or module.startswith(f"{name}/") for name in (*_NEVER, *self.apart)
            ):
                found.add(module)
                waiting += _imports(module)
        return tuple(sorted(found))

    def digest(self) -> str:
        """A short name for this code as it is now (another one under another version of Python)."""
        return hashlib.sha256(
            "".join(f"{module} {_meaning(module)}\n" for module in self.files()).encode()
        ).hexdigest()[:16]


MAPPING = StageCode(("topoloc/mapping/build.py", _READING))


def asking(coarse: str, *others: str) -> StageCode:
    """Queries answered by a `Localizer` with this coarse localizer; `others` are modules that take
    part."""
    answering = (
        "topoloc/evaluation/query_localization.py",
        "topoloc_paper/stored_answers.py",
        _READING,
    )
    return StageCode((*answering, COARSE_MODULES[coarse], *others), _COUNTING)


def answering(*modules: str) -> StageCode:
    """Return the code of a peer. It may use the map's coarse localizer but not topoloc's fine
    step."""
    return StageCode(
        (*modules, COARSE_MODULES["surf-vlad"], _READING), (*_COUNTING, "topoloc/localization")
    )


def learning(*modules: str) -> StageCode:
    """A network taught with the mapping images. These the stage's settings name, so how they are
    read and stored does not count."""
    apart = (
        "topoloc/features",
        "topoloc/recordings",
        "topoloc/mapping/topomap.py",
        "topoloc/retrieval/coarse.py",
    )
    return StageCode(("topoloc_training/coarse_training.py", *modules), apart)


@cache
def _imports(module: str) -> tuple[str, ...]:
    """The modules of ours that a module imports, at any depth of it, but for those that only the
    type checker sees."""
    tree = _Running().visit(ast.parse(_file(module).read_bytes()))
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    paths = {
        name.replace(".", "/") + ".py"
        for name in names
        if name.partition(".")[0] in ROOTS and "." in name
    }
    return tuple(sorted(path for path in paths if _file(path).is_file()))


def _file(module: str) -> Path:
    return ROOTS[module.split("/")[0]] / module


@cache
def _meaning(module: str) -> str:
    """Return a digest of a module's behaviour, independent of its formatting."""
    tree = _Running().visit(ast.parse(_file(module).read_bytes()))
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


class _Running(ast.NodeTransformer):
    """Remove nodes without effect at run time: docstrings, and imports for the type checker."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        return (
            None
            if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
            else self.generic_visit(node)
        )

    def visit_If(self, node: ast.If) -> ast.AST | None:
        return (
            None
            if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
            else self.generic_visit(node)
        )
