"""topoloc: a place mapped once with a stereo or RGB-D camera; afterwards any single image of it
gets a metric 6-DoF pose.

`__init__.pyi` lists the public names. Each one loads its module at its first use, so that
`import topoloc` costs nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


def attach_stub(module: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a module: the names that its stub imports.

    `file` is the file of the module. The stub is the .pyi file beside it, which type checkers and
    editors read, too. It is read at the first use of a name."""
    sources: dict[str, str] = {}

    def names() -> list[str]:
        if not sources:
            import ast
            from pathlib import Path

            for node in ast.parse(Path(file).with_suffix(".pyi").read_text("utf-8")).body:
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("topoloc."):
                    sources.update({alias.name: str(node.module) for alias in node.names})
        return sorted(sources)

    def load(name: str) -> Any:
        if name == "__all__":
            return names()
        if name not in names():
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        import importlib

        value = getattr(importlib.import_module(sources[name]), name)
        setattr(sys.modules[module], name, value)
        return value

    return load, names


_load, _names = attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("topoloc")
    return __dir__() if name == "__all__" else _load(name)


def __dir__() -> list[str]:
    return sorted([*_names(), "__version__"])
