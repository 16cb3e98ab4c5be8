"""topoloc: a place mapped once with a stereo or RGB-D camera; afterwards any single image of it
gets a metric 6-DoF pose.

`__init__.pyi` lists the public names. Each one loads its module at its first use, so that
`import topoloc` costs nothing.
"""

from __future__ import annotations

import ast
import importlib
import os
import sys
from collections.abc import Callable
from typing import Any


def attach_stub(
    module: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a module: the names that its stub imports.

    `file` is the file of the module. The stub is the .pyi file beside it, which type checkers and
    editors read, too."""
    with open(os.path.splitext(file)[0] + ".pyi", encoding="utf-8") as stub:
        tree = ast.parse(stub.read())
    sources = {
        alias.name: node.module
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("topoloc.")
        for alias in node.names
    }
    names = sorted(sources)

    def load(name: str) -> Any:
        if name not in sources:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(sources[name]), name)
        setattr(sys.modules[module], name, value)
        return value

    return load, lambda: list(names), names


_load, _, _names = attach_stub(__name__, __file__)
__all__ = sorted([*_names, "__version__"])


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("topoloc")
    return _load(name)


def __dir__() -> list[str]:
    return list(__all__)
