"""Test an installation: the wheel is complete, the command runs, and heavy modules are imported
only when needed."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tyro

import topoloc
from topoloc.apps.cli import COMMANDS, EXAMPLES, PLUGIN_PACKAGES, all_commands, main

ROOT = Path(__file__).parents[1]
HEAVY = ("cv2", "faiss", "fastapi", "httpx", "matplotlib", "numba", "numpy", "onnxruntime")
HEAVY += ("poselib", "pydantic", "torch", "tyro", "uvicorn")
# The core runs without these: the extras and the tools of the tests.
FOREIGN = (
    "torch",
    "torchvision",
    "mitsuba",
    "matplotlib",
    "cryptography",
    "cyclonedds",
    "carla",
    "pyzed",
    "ray",
    "mcap",
    "rosbags",
    "google",
    "lz4",
    "zstandard",
    "mcap_protobuf",
    "foxglove_schemas_protobuf",
    "scipy",
    "hypothesis",
    "beartype",
    "pytest",
)
_IMPORT_ALL = """
import importlib, json, pkgutil, sys

class Barred:
    asked = set()
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in FOREIGN:
            self.asked.add(name.split(".")[0])
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Barred())
import topoloc
names = [module.name for module in pkgutil.walk_packages(topoloc.__path__, "topoloc.") if module.name != "topoloc.__main__"]
not_loaded = []
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        assert error.name.split(".")[0] in ("matplotlib", "mcap", "cyclonedds"), (name, error)
        not_loaded.append(name)
print(json.dumps([names, not_loaded, sorted(Barred.asked)]))
"""  # noqa: E501


def _run(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        capture_output=True,
        text=True,
        env=environment,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel, built from the source distribution as an index would serve it."""
    folder = tmp_path_factory.mktemp("dist")
    built = _run(
        sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, **os.environ
    )
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the program folder of a virtual environment with only the wheel, without
    its dependencies."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=False, symlinks=os.name != "nt")
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    pip = (
        sys.executable,
        "-m",
        "pip",
        "--python",
        programs / "python",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        wheel,
    )
    done = _run(*pip, **os.environ)
    assert done.returncode == 0, done.stderr
    return programs


def test_the_wheel_contains_each_module_its_data_and_the_licence(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    files = {
        path
        for path in (ROOT / "src" / "topoloc").rglob("*")
        if path.is_file() and path.parent.name != "__pycache__"
    }
    assert {path.relative_to(ROOT / "src").as_posix() for path in files} <= names
    assert {name.split("/")[0] for name in names} == {
        "topoloc",
        f"topoloc-{topoloc.__version__}.dist-info",
    }
    assert any(name.endswith("/LICENSE") for name in names)


@pytest.mark.parametrize("program", [("topoloc",), ("python", "-m", "topoloc")], ids=" ".join)
def test_help_answers_in_an_empty_environment(installed: Path, program: tuple[str, ...]):
    answer = _run(installed / program[0], *program[1:], "--help")
    assert answer.returncode == 0, answer.stderr
    assert answer.stderr == ""
    assert all(f"  {command}  " in answer.stdout for command in COMMANDS)


def test_the_version_is_the_one_of_the_package(installed: Path):
    answer = _run(installed / "topoloc", "--version")
    assert (answer.returncode, answer.stdout) == (0, f"{topoloc.__version__}\n")


def test_each_example_of_the_help_is_a_command_line_that_parses():
    examples = [words.split() for group in EXAMPLES.values() for words in group]
    assert len(examples) == 15
    for name, *words in examples:
        tyro.cli(importlib.import_module(COMMANDS[name][0]).Command, args=words)


def test_help_and_version_have_their_short_forms(capsys: pytest.CaptureFixture[str]):
    assert main(["-V"]) == 0
    assert capsys.readouterr().out == f"{topoloc.__version__}\n"
    assert main(["help"]) == 0
    assert "map a place:" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        main(["help", "undo"])
    assert not stop.value.code
    assert "usage: topoloc undo" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "complaint"),
    [
        ((), ""),
        (("fly",), "error: unknown command 'fly'"),
        (("loclize",), "error: unknown command 'loclize'; did you mean localize?"),
        (("simulate", "lab", "out", "--fly"), "--fly"),
        (("info", "x.topo", "--fly"), "--fly"),
    ],
)
def test_wrong_usage_exits_with_2(args: tuple[str, ...], complaint: str):
    answer = _run(sys.executable, "-m", "topoloc", *args, **os.environ)
    assert answer.returncode == 2
    assert complaint in answer.stderr
    assert "Traceback" not in answer.stderr


@pytest.mark.parametrize(("command", "distribution"), PLUGIN_PACKAGES.items())
def test_missing_commands_of_other_distributions_are_named(
    installed: Path, command: str, distribution: str
):
    answer = _run(installed / "topoloc", command, "lab", "out")
    assert (answer.returncode, answer.stdout) == (2, "")
    assert (
        answer.stderr
        == f"error: `topoloc {command}` needs {distribution}, which is not installed\n"
    )


@pytest.mark.parametrize("command", all_commands())
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    assert f"usage: topoloc {command} " in capsys.readouterr().out


@pytest.mark.parametrize(
    "statement", ["import topoloc", "from topoloc.apps.cli import main; main(['--help'])"]
)
def test_nothing_heavy_is_loaded_before_it_is_needed(statement: str):
    code = f"import sys; {statement}; print([name for name in {HEAVY} if name in sys.modules])"
    answer = _run(sys.executable, "-c", code, **os.environ)
    assert answer.stdout.splitlines()[-1] == "[]", answer.stderr


def test_every_module_loads_without_extras_but_figures_and_messages():
    answer = _run(
        sys.executable,
        "-c",
        f"FOREIGN = {FOREIGN}\n{_IMPORT_ALL}",
        **os.environ,
    )
    assert answer.returncode == 0, answer.stderr
    modules, not_loaded, asked = json.loads(answer.stdout)
    assert "topoloc.localization.localizer" in modules
    drawing = {
        f"topoloc.apps.report.{name}"
        for name in ("certificate_page", "figures", "map_figure", "report", "weak_regions_page")
    }
    others = [name for name in not_loaded if name not in drawing]
    assert others == [
        "topoloc.apps.formats.bags.mcap_file",
        "topoloc.apps.robots.ros_announcement",
        "topoloc.apps.robots.ros_messages",
    ]
    assert {"torch", "torchvision"}.isdisjoint(asked)


def test_public_names_are_there_and_no_others():
    assert dir(topoloc) == topoloc.__all__
    for name in topoloc.__all__:
        assert getattr(topoloc, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        topoloc.fly  # noqa: B018 # pyright: ignore[reportAttributeAccessIssue]


def test_objects_print_as_one_line(room_map: Path, queries: Path):
    sequence, topomap = topoloc.open_sequence(queries), topoloc.TopoMetricMap.load(room_map)
    frame, localizer = sequence[0], topoloc.Localizer(topomap)
    answer = localizer.localize(frame.image, frame.camera)
    refusal = localizer.localize(np.zeros_like(frame.image), frame.camera)
    trajectory = topoloc.Trajectory.of_frames(sequence.poses, sequence.t_ns)
    selected = topoloc.open_sequence(f"{queries}@0:2")
    for one in (sequence, selected, frame, topomap, answer, refusal, trajectory, frame.camera):
        assert "\n" not in repr(one)
        assert type(one).__name__ in repr(one)
        assert len(repr(one)) < 300
    assert re.search(r"translation \(.*\) m.* sigma 0\.\d cm, .* p [01]\.\d+", repr(answer))
    assert "too_few" in repr(refusal)
