"""matplotlib keeps its list of fonts in our cache folder, and the user's settings stay valid."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib", reason="the extra report is not installed")
_LOAD = """
import os
before = dict(os.environ)
from topoloc.apps.report.plotting import load_matplotlib
load_matplotlib()
assert dict(os.environ) == before
import matplotlib.pyplot
print(matplotlib.rcParams["font.size"])
"""


def _run(home: Path, temporary: Path, **variables: str) -> str:
    foreign = ("XDG", "MPL", "MATPLOTLIB", "TOPOLOC_CACHE")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
    own = {"HOME": str(home), "TMPDIR": str(temporary), "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", _LOAD],
        env=kept | own | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout.strip()


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    return folder


def test_fonts_lie_in_our_cache_and_settings_are_the_users(tmp_path: Path, temporary: Path):
    settings = tmp_path / ".config" / "matplotlib" / "matplotlibrc"
    settings.parent.mkdir(parents=True)
    settings.write_text("font.size: 17\n")
    assert _run(tmp_path, temporary) == "17.0"
    assert [path.name for path in settings.parent.iterdir()] == ["matplotlibrc"]
    (cached,) = (tmp_path / ".cache").iterdir()
    assert list(cached.glob("matplotlib/fontlist*.json"))


def test_a_folder_of_the_user_is_used(tmp_path: Path, temporary: Path):
    own = tmp_path / "own"
    own.mkdir()
    _run(tmp_path, temporary, MPLCONFIGDIR=str(own))
    assert list(own.glob("fontlist*.json"))
    assert not (tmp_path / ".cache").exists()


def test_without_a_home_nothing_is_left(tmp_path: Path, temporary: Path):
    (tmp_path / "file").touch()
    _run(tmp_path / "file", temporary)
    assert list(temporary.iterdir()) == []
