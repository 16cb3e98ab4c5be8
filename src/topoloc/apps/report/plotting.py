"""Import matplotlib without files in the user's folders."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from topoloc.apps.core_names import temporary_folder
from topoloc.plugin import cache_folder

_FOLDER, _SETTINGS = "MPLCONFIGDIR", "MATPLOTLIBRC"


def load_matplotlib() -> None:
    """Import matplotlib, with its list of fonts in topoloc's cache folder instead of its own.

    A folder of the user in MPLCONFIGDIR and the user's matplotlibrc stay valid, and so does a
    matplotlib that is already imported. The environment is the same afterwards. Raises ImportError.
    """
    if "matplotlib" in sys.modules or _FOLDER in os.environ:
        return
    with _writable_folder() as folder, _environment(folder):
        import matplotlib.font_manager  # noqa: F401  # reads or writes the list of fonts


@contextmanager
def _writable_folder() -> Iterator[Path]:
    """Yield a folder within the cache folder, or else a temporary one."""
    if folder := _find_cache():
        yield folder
    else:
        with temporary_folder("topoloc-fonts-") as temporary:
            yield temporary


def _find_cache() -> Path | None:
    """Return the folder within the cache folder, None if it cannot be written."""
    try:
        folder = cache_folder() / "matplotlib"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # the latter: the user has no home folder
        return None
    return folder if os.access(folder, os.W_OK) else None


@contextmanager
def _environment(folder: Path) -> Iterator[None]:
    """Set the folder of matplotlib, and its settings to the user's, for the time of an import."""
    before = dict(os.environ)
    if own := _user_settings():
        os.environ.setdefault(_SETTINGS, str(own))
    os.environ[_FOLDER] = str(folder)
    try:
        yield
    finally:
        for name in (_FOLDER, _SETTINGS):
            os.environ.pop(name, None)
        os.environ |= {name: before[name] for name in (_FOLDER, _SETTINGS) if name in before}


def _user_settings() -> Path | None:
    """Return the user's matplotlibrc, None if there is none."""
    try:
        home = Path.home()
    except RuntimeError:
        return None
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / "matplotlib"
    found = (folder / "matplotlibrc" for folder in (settings, home / ".matplotlib"))
    return next((path for path in found if path.is_file()), None)
