"""Run the examples as their first lines show, and check their output."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.features import feature_types
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.trajectory import Trajectory
from topoloc.retrieval import coarse

EXAMPLES = Path(__file__).parents[1] / "examples"
MAX_LINES = 86

Run = Callable[..., str]


def _run_in(folder: Path, patch: pytest.MonkeyPatch, name: str, *args: object) -> None:
    patch.chdir(folder)
    patch.setenv("MPLBACKEND", "Agg")
    patch.setattr(sys, "argv", [f"examples/{name}.py", *map(str, args)])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs an example in an empty folder, as a shell does, and
    returns its output."""

    def run_example(name: str, *args: object) -> str:
        _run_in(tmp_path, monkeypatch, name, *args)
        return capsys.readouterr().out

    return run_example


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a map of the shipped lab, and the output of the example that built it."""
    folder, printed = tmp_path_factory.mktemp("example"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        _run_in(folder, patch, "map_and_localize", "--ask", SHIPPED / "day@0::8")
    return folder / "lab.topo", printed.getvalue()


@pytest.fixture
def lab(mapped: tuple[Path, str]) -> Path:
    return mapped[0]


def _centimetres(text: str, before: str) -> list[float]:
    return [float(number) for number in re.findall(rf"{before} ([\d.]+) cm", text)]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_names_its_command_and_is_tested_here(path: Path):
    text = path.read_text(encoding="utf-8")
    docstring = ast.get_docstring(ast.parse(text))
    assert docstring
    assert f"    python examples/{path.name}" in docstring
    assert len(text.splitlines()) <= MAX_LINES
    call = rf'run(_in)?\(\s*(folder,\s*patch,\s*)?"{path.stem}"'
    assert re.search(call, Path(__file__).read_text(encoding="utf-8"))


def test_map_and_localize(mapped: tuple[Path, str]):
    path, printed = mapped
    assert len(TopoMetricMap.load(path).nodes) > 20
    assert "not localized" not in printed
    errors = _centimetres(printed, "off by")
    assert len(errors) == 4
    assert max(errors) < 2.0


def test_as_on_linux_on_arm_without_poselib(lab: Path):
    no_poselib = (
        "import sys; sys.modules['poselib'] = None; from topoloc.apps.cli import main; main()"
    )
    command = "evaluate", lab, f"{SHIPPED / 'day'}@0::4", f"{SHIPPED / 'night'}@0::4", "--json", "-"
    printed = subprocess.run(
        [sys.executable, "-c", no_poselib, *command], check=True, capture_output=True, text=True
    ).stdout
    found = json.loads(printed)
    assert found["num_localized"] == found["num_queries"] == 16
    assert found["num_inaccurate"] == 0
    assert found["median_translation_m"] < 0.01


def test_localize_folder(run: Run, lab: Path, tmp_path: Path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for source in ("camera.json", "images/000000.jpg", "images/000004.jpg"):
        (photos / Path(source).name).write_bytes((SHIPPED / "day" / source).read_bytes())
    cv2.imwrite(str(photos / "black.png"), np.zeros((400, 640), np.uint8))
    (photos / "broken.jpg").write_bytes(b"no picture")
    printed = run("localize_folder", lab, photos, "--out", "answers")
    assert "2 of 4 photos localized" in printed
    lines = [
        json.loads(line) for line in (tmp_path / "answers" / "poses.jsonl").read_text().splitlines()
    ]
    assert {line["query"]: line.get("reason") for line in lines} == {
        "000000.jpg": None,
        "000004.jpg": None,
        "black.png": "too_few_matches",
        "broken.jpg": "unreadable",
    }
    assert len(Trajectory.read(tmp_path / "answers" / "poses.tum")) == 2


def test_own_camera(run: Run, lab: Path, monkeypatch: pytest.MonkeyPatch):
    """The example makes the same map as the first one."""
    recordings: list[StereoSequence] = []
    monkeypatch.setattr(
        topoloc,
        "build_map",
        lambda recording: recordings.append(recording) or TopoMetricMap.load(lab),
    )
    with_lens, as_pinhole = run("own_camera").splitlines()
    assert [recording.name for recording in recordings] == ["map_lap1"]
    assert "8 of 8 localized" in with_lens
    (error,) = _centimetres(with_lens, "median error")
    assert error < 1.5
    (localized,) = re.findall(r"(\d) of 8 localized", as_pinhole)
    assert int(localized) >= 5, "by the lens that the images show"
    (error,) = _centimetres(as_pinhole, "median error")
    assert error < 4.0
    assert "its lens distorts more than the calibration states" in as_pinhole


def test_reject_elsewhere(run: Run, lab: Path):
    printed = run(
        "reject_elsewhere", lab, SHIPPED / "day@0::8", SHIPPED / "corridor", SHIPPED / "street@0::2"
    )
    accepted = re.findall(r"^(\S+): (\d+) of (\d+) accepted", printed, re.MULTILINE)
    assert accepted == [("day@0::8", "4", "4"), ("corridor", "0", "8"), ("street@0::2", "0", "4")]


@pytest.mark.slow
def test_follow_stream(run: Run):
    printed = run("follow_stream")
    assert re.findall(r"^images/0000(\d\d)\.jpg: predicted \((\w+)\)", printed, re.MULTILINE) == [
        ("08", "too_few_matches"),
        ("09", "too_few_matches"),
        ("20", "jump"),
    ]
    assert ": lost" not in printed
    assert max(_centimetres(printed, "median error")) < 1.5


def test_slam_trajectory(run: Run, tmp_path: Path):
    printed = run("slam_trajectory", SHIPPED / "map_lap1@0:14")
    assert "14 of 14 frames tracked" in printed
    assert max(_centimetres(printed, "absolute trajectory error")) < 2.0
    assert len(Trajectory.read(tmp_path / "lap.tum")) == 14
    where = re.search(r"found at \[(.*?)\] m", printed)
    assert where
    assert np.abs(np.array(where.group(1).split(), float)).max() < 0.01


def test_inspect_map(run: Run, lab: Path, tmp_path: Path):
    printed = run("inspect_map", lab)
    assert f"{len(TopoMetricMap.load(lab).nodes)} nodes" in printed
    assert cv2.imread(str(tmp_path / "map.png")).std() > 5.0


def test_own_features(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A map of ORB opens if ORB is registered. Otherwise the error names the remedy."""
    monkeypatch.setattr(feature_types, "FEATURE_TYPES", dict(feature_types.FEATURE_TYPES))
    printed = run("own_features")
    assert "8 of 8 localized" in printed
    assert max(_centimetres(printed, "median error")) < 0.5
    assert TopoMetricMap.load(tmp_path / "lab_orb.topo").kinds == ["orb"]
    _refuses_in_a_new_process(
        tmp_path / "lab_orb.topo", "lab_orb.topo: no features of kind 'orb'", "feature_type"
    )
    surf = feature_types.FEATURE_TYPES["surf"]
    with pytest.raises(topoloc.FeatureTypeError, match="'surf' are topoloc's"):
        feature_types.register_feature_type(surf)


def test_own_retrieval(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(coarse, "_extensions", {})
    printed = run("own_retrieval")
    assert "8 of 8 localized" in printed
    assert max(_centimetres(printed, "median error")) < 0.5
    _refuses_in_a_new_process(
        tmp_path / "lab_thumbs.topo",
        "MapError: the map's coarse localizer 'thumbnails' is not known",
        "coarse_localizer",
    )
    with pytest.raises(topoloc.ConfigError, match="'cnn-nn' is topoloc's"):
        coarse.register_coarse_localizer(
            "cnn-nn", lambda model: coarse.open_coarse_localizer(model)
        )


def _refuses_in_a_new_process(path: Path, fault: str, remedy: str) -> None:
    program = f"import topoloc; topoloc.Localizer({str(path)!r})"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert fault in done.stderr
    assert f"topoloc.plugin.register_{remedy}" in done.stderr.splitlines()[-1]


def test_first_map_notebook(tmp_path: Path):
    """The code cells run in order. As in a notebook, the last line of each is shown."""
    path = EXAMPLES / "first_map.ipynb"
    notebook = json.loads(path.read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [(cell["outputs"], cell["execution_count"]) for cell in cells] == [([], None)] * 4
    codes = ["".join(cell["source"]) for cell in cells]
    shown = [ast.parse(code).body[-1] for code in codes]
    program = f"""
import json
names = {{}}
for code, last in {[(code, ast.unparse(last)) for code, last in zip(codes, shown, strict=True)]!r}:
    exec(code, names)
    if not last.startswith(("import", "from", "print")):
        value = eval(last, names)
        print(getattr(value, "_repr_html_", value.__repr__)())
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "<svg" in done.stdout
    assert "<div>Localization(" in done.stdout
    (error,) = _centimetres(done.stdout, "median error")
    assert error < 0.5
    assert (tmp_path / "lab.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cnn-fc", "cnn-nn"])
def test_train_classifier(run: Run, name: str, tmp_path: Path, request: pytest.FixtureRequest):
    pytest.importorskip("torch")
    weights: tuple[object, ...] = ()
    if name == "cnn-nn":
        weights = (
            "--weights",
            request.getfixturevalue("shared") / "weights/squeezenet1_1-imagenet-features.pth",
        )
    printed = run("train_classifier", "--epochs", 1, *weights)
    assert set(TopoMetricMap.load(tmp_path / "lab_learned.topo").first_layer.coarse_models) >= {
        "surf-vlad",
        name,
    }
    near = re.search(rf"^{name}: .* in (\d+) %$", printed, re.MULTILINE)
    assert near
    if name == "cnn-nn":  # one epoch from nothing promises little
        assert int(near.group(1)) >= 90
