"""Run the commands of README.md and the quickstart in order, in one folder, with the libraries that
`make demo` installs. The Python code of README runs, too."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import topoloc
from test_package import FOREIGN
from topoloc.apps.cli import COMMANDS
from topoloc.demo.recordings import SHIPPED

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/quickstart.md")

# Word on a page -> typed word: the reader's folders and images are parts of the demo's.
PLACEHOLDERS = {"MAP": "office.topo", "RECORDING": "walk", "FOLDER": "office"}
NOT_TYPED = {
    "pip install": "fetches packages from an index; the wheels have tests of their own",
    "make install": "fetches packages from an index",
    "make demo": "makes an environment; then it types `topoloc demo`, which is typed here",
    "make test": "runs this file",
    "make docs": "the pages are built by tests/test_pages.py",
    "python benchmarks/": "measures for minutes, on recordings outside the repository",
    "topoloc train": "needs topoloc-training, which the page says; typed by tests/training",
}
# Commands typed by `make test`. `make test-slow` types the rest.
QUICK = ("topoloc build office/", "topoloc localize office.topo", "topoloc evaluate MAP")
BARRED = (*(set(FOREIGN) - {"matplotlib"}), "topoloc_worlds", "topoloc_training", "topoloc_paper")
_BAR = f"""
import sys

class Barred:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BARRED}:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Barred())
"""
_PAIRS = """
import cv2
pairs = [
    (i * 100_000_000, *(cv2.imread(f"office/{side}/{i:04}.png", 0) for side in ("left", "right")))
    for i in range(6)
]
"""


def _commands() -> list[str]:
    """Return the lines of the shell blocks and the commands with arguments in the text."""
    found = list[str]()
    programs = "topoloc|python|pip|make"
    for name in PAGES:
        page = (ROOT / name).read_text(encoding="utf-8")
        for block, inline in re.findall(
            rf"^```sh\n(.*?)^```|`((?:{programs}) [^`]+)`", page, re.MULTILINE | re.DOTALL
        ):
            lines = block.splitlines() if block else [" ".join(inline.split())]
            found += [line.partition("  #")[0].strip() for line in lines if line.strip()]
    names = {f"topoloc {name}" for name in COMMANDS} | {"topoloc simulate", "topoloc benchmark"}
    return [command for command in found if command not in names or command == "topoloc demo"]


def _is_typed(command: str) -> bool:
    return not command.startswith(tuple(NOT_TYPED))


def _resampled(image: np.ndarray, size: tuple[int, int], f: float, c: tuple[float, float]):
    """Return an image of the demo's camera (f 380 px, centre 319.5, 199.5) as another camera at the
    same position sees it."""
    old = np.array([[380.0, 0, 319.5], [0, 380.0, 199.5], [0, 0, 1]])
    new = np.array([[f, 0, c[0]], [0, f, c[1]], [0, 0, 1]])
    return cv2.warpPerspective(image, new @ np.linalg.inv(old), size, flags=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files of a reader: office/, walk/ and photo.jpg, all from
    the demo's lab."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(_BAR, encoding="utf-8")
    lap, day = topoloc.open_sequence(SHIPPED / "map_lap1"), topoloc.open_sequence(SHIPPED / "day")
    for side in ("left", "right"):
        (folder / "office" / side).mkdir(parents=True)
    (folder / "walk" / "images").mkdir(parents=True)
    size, centre = (640, 480), (319.5, 239.5)
    for i in range(12):
        frame = lap[i]
        assert frame.right is not None
        for side, image in (("left", frame.image), ("right", frame.right)):
            target = folder / "office" / side / f"{i:04}.png"
            cv2.imwrite(str(target), _resampled(image, size, 525, centre))
    calibration = {"model": "PINHOLE", "width": 640, "height": 480, "fx": 525.0, "fy": 525.0}
    calibration |= {"cx": 319.5, "cy": 239.5, "baseline": 0.12}
    (folder / "office" / "camera.json").write_text(json.dumps(calibration), encoding="utf-8")
    trajectory = topoloc.Trajectory.of_frames(lap.poses[:12], [i * 100_000_000 for i in range(12)])
    trajectory.write_tum(folder / "office" / "truth.tum")
    near = [i for i in range(len(day)) if _distance(day, i, lap) < 0.6][:3]
    for row, i in enumerate(near):
        target = folder / "walk" / "images" / f"{row:04}.png"
        cv2.imwrite(str(target), _resampled(day[i].image, size, 525, centre))
    del calibration["baseline"]
    (folder / "walk" / "camera.json").write_text(json.dumps(calibration), encoding="utf-8")
    poses = topoloc.Trajectory.of_frames([day.poses[i] for i in near], [0, 10**8, 2 * 10**8])
    poses.write_tum(folder / "walk" / "truth.tum")
    photo = _resampled(day[near[1]].image, size, 525, (320, 240))
    cv2.imwrite(str(folder / "photo.jpg"), photo)
    return folder


def _distance(day: topoloc.StereoSequence, i: int, lap: topoloc.StereoSequence) -> float:
    """Return metres from an image to the nearest of the mapped poses that look the same way."""
    image = day.poses[i]
    assert image is not None
    metres = [9.0]
    for pose in lap.poses[2:10]:
        assert pose is not None
        if (image.rotation[:, 2] @ pose.rotation[:, 2]) > 0.9:
            metres.append(float(np.linalg.norm(image.translation - pose.translation)))
    return min(metres)


def _environment(place: Path) -> dict[str, str]:
    programs = str(Path(sys.executable).parent)
    return os.environ | {
        "PATH": os.pathsep.join((programs, os.environ.get("PATH", ""))),
        "PYTHONPATH": os.pathsep.join((str(place / "site"), os.environ.get("PYTHONPATH", ""))),
    }


def _type(script: str, place: Path, *program: str) -> str:
    """Return the standard output of a program. It must exit with 0 and print no error."""
    done = subprocess.run(
        [*program, script],
        cwd=place,
        env=_environment(place),
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}{done.stderr}"
    assert "error:" not in done.stderr
    return done.stdout


def _type_in_shell(commands: list[str], place: Path) -> str:
    """Type commands in one shell, so that later lines can use its variables."""
    words = re.compile(rf"\b({'|'.join(PLACEHOLDERS)})\b")
    lines = [words.sub(lambda word: PLACEHOLDERS[word[0]], command) for command in commands]
    return _type("\n".join(lines), place, "bash", "-euo", "pipefail", "-c")


def _serve(command: str, place: Path) -> str:
    """Start a service at a free port, return its line, and end it with Ctrl-C."""
    service = subprocess.Popen(
        [*command.split(), "--port", "0"],
        cwd=place,
        env=_environment(place),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert service.stdout
    lines = list[str]()
    for line in service.stdout:
        lines.append(line)
        if "ready" in line:  # before, Ctrl-C interrupts the start
            break
    service.send_signal(signal.SIGINT)
    lines.append(service.communicate(timeout=60)[0])
    assert service.returncode == 0, "".join(lines)
    return "".join(lines)


def test_each_command_is_typed_or_has_a_reason():
    commands = _commands()
    assert len(commands) >= 20
    for start in (*NOT_TYPED, *QUICK):
        assert any(command.startswith(start) for command in commands), f"no page has {start}"
    programs = {command.split()[0] for command in commands if _is_typed(command)}
    assert programs == {"topoloc", "LAB=$(python"}


def test_first_commands_of_readme_work(place: Path):
    commands = list(dict.fromkeys(one for one in _commands() if one.startswith(QUICK)))
    printed = _type_in_shell(commands, place)
    assert "photo.jpg: localized" in printed or re.search(r"photo\.jpg.*sigma", printed), printed
    assert "3 of 3" in printed


def test_python_of_readme_runs(place: Path):
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    end = 'print(len(topomap.nodes), "nodes")'
    printed = _type("\n".join([blocks[0], _PAIRS, blocks[1], end]), place, sys.executable, "-c")
    assert "not localized" not in printed
    assert re.search(r"^[1-9]\d* nodes$", printed, re.MULTILINE)


@pytest.mark.slow
def test_all_commands_work_in_their_order(place: Path):
    """`make demo` runs first, as on the pages. A service ends with Ctrl-C."""
    shutil.rmtree(place / "topoloc-demo", ignore_errors=True)
    (place / "office.topo").unlink(missing_ok=True)
    block = list[str]()
    for command in ["topoloc demo", *filter(_is_typed, _commands())]:
        if command.startswith("topoloc serve"):
            assert "http://127.0.0.1:" in _serve(command, place)
        elif command.startswith("LAB=") or block:
            block.append(command)
            if "--report" in command:  # the last line of the block
                assert "8 of 8" in _type_in_shell(block, place)
                block = []
        else:
            _type_in_shell([command], place)
    for name in ("topoloc-demo/report.html", "office.topo", "lab.topo", "poses.tum"):
        assert (place / name).stat().st_size > 0
