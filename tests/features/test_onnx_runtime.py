"""ONNX Runtime is loaded with its telemetry off, unless the user has set the variable."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from traced import users_environment

_STATE = "from topoloc.features.network_files import find_telemetry, load_onnxruntime\n"
_LOAD = f"{_STATE}load_onnxruntime()\nload_onnxruntime()\nprint(find_telemetry())\n"
_FOLDER = Path(".cache") / "Microsoft"


def _run(code: str, home: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    own = {"HOME": str(home), "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=users_environment() | own | variables,
        capture_output=True,
        text=True,
        check=True,
    )


def test_it_is_off_and_leaves_no_file(tmp_path: Path):
    child = "import os; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    inherited = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    done = _run(_LOAD + inherited, tmp_path)
    assert sorted(done.stdout.split()) == ["1", "off"]
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_importing_topoloc_sets_nothing(tmp_path: Path):
    code = "import os, topoloc.features.network_files; print('ORT_DISABLE_TELEMETRY' in os.environ)"
    assert _run(code, tmp_path).stdout.strip() == "False"


@pytest.mark.parametrize(
    ("variables", "state"),
    [
        ({"ORT_DISABLE_TELEMETRY": "0"}, "on by the environment"),
        ({"ORT_TELEMETRY_DISABLED": "0"}, "on by the environment"),
        ({"ORT_DISABLE_TELEMETRY": "True"}, "off"),
        ({"ORT_TELEMETRY_DISABLED": "1"}, "off"),
    ],
)
def test_a_value_of_the_user_stands(tmp_path: Path, variables: dict[str, str], state: str):
    """What the words mean is compared with what the library does on this machine."""
    home, plain = tmp_path / "home", tmp_path / "plain"
    home.mkdir()
    plain.mkdir()
    assert _run(_LOAD, home, **variables).stdout.strip() == state
    _run("import onnxruntime", plain)
    assert (home / _FOLDER).exists() == (state != "off" and (plain / _FOLDER).exists())


def test_an_earlier_import_is_logged_once_and_is_a_fault_of_doctor(tmp_path: Path):
    done = _run(f"import onnxruntime\n{_LOAD}", tmp_path)
    assert done.stdout.strip() == "on by an earlier import"
    (line,) = done.stderr.splitlines()
    assert "imported before topoloc" in line
    assert "set ORT_DISABLE_TELEMETRY=1" in line
    code = "from topoloc.apps.cli import doctor\nimport onnxruntime\n"
    done = _run(f"{code}print(doctor._examine_telemetry())", tmp_path)
    assert "set ORT_DISABLE_TELEMETRY=1" in done.stdout
    done = _run(f"{code}print(doctor._examine_telemetry())", tmp_path, ORT_DISABLE_TELEMETRY="1")
    assert done.stdout.strip() == "({'onnxruntime': 'off'}, [])"


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder that nobody can write to")
@pytest.mark.parametrize("home", ["/proc/none", "a file"])
def test_without_a_home_a_map_is_built_without_a_line(tmp_path: Path, home: str):
    (tmp_path / "a file").touch()
    path = tmp_path / "lab.topo"
    build = (
        "import topoloc, sys\n"
        "from topoloc.demo.recordings import SHIPPED\n"
        "walk = topoloc.open_sequence(f\"{SHIPPED / 'map_lap1'}@0:3\")\n"
        f"topoloc.build_map(walk).save({str(path)!r})\n"
        "assert 'onnxruntime' in sys.modules\n"
    )
    done = _run(build, tmp_path / home if home == "a file" else Path(home))
    assert done.stderr == ""
    assert path.is_file()
