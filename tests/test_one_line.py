"""Test the display in an interactive session: one line per public object, and some lines per result
in a notebook. Type checkers distinguish the two results."""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

import topoloc
from test_docs import LOCALIZED
from topoloc.localization.config import LocalizerConfig
from topoloc.mapping.config import MapConfig
from topoloc.mapping.topomap import TopoMetricMap

IDENTITY = topoloc.Rigid3.identity()
CAMERA = topoloc.Camera(
    "OPENCV", 640, 400, (380.123456789012, 380.12345678901, 0.1234567890123, 0.1, *[1e-17 / 3] * 4)
)
FRAME = topoloc.StereoFrame("a", 0, np.zeros((400, 640), np.uint8), CAMERA)
PLACE = topoloc.GeoPoint(48.123456789012, 11.123456789012, 520.123456789)
LONG = topoloc.NotLocalized("unreadable", detail="a file\n" * 500)
MANY = [topoloc.EvaluatedQuery("a" * 90, LOCALIZED, IDENTITY)] * 10_000

PROGRAM = """
import topoloc

def of(result: topoloc.Localization | topoloc.NotLocalized, recording: topoloc.StereoSequence):
    if result.localized is True:
        reveal_type(result)
    else:
        reveal_type(result.reason and result)
    reveal_type(recording[1:2])
    reveal_type(recording[1])
    recording["first"]
    result.probability
"""


def _objects(room_map: Path) -> list[object]:
    """Return objects of the public classes, each as large as it may get."""
    topomap = TopoMetricMap.load(room_map)
    to_right = topoloc.Rigid3(np.eye(3), np.array([-0.12, 0.0, 0.0]))
    return [
        CAMERA,
        topoloc.StereoRig(CAMERA, CAMERA, to_right),
        topoloc.DepthImage(np.zeros((400, 640), np.float32), CAMERA),
        FRAME,
        topoloc.MemorySequence([FRAME]),
        IDENTITY,
        PLACE,
        topoloc.Georeference(PLACE, IDENTITY, "a source"),
        topoloc.GeoreferenceResult(
            topoloc.Georeference(PLACE, IDENTITY, "points"),
            0.0,
            None,
            ["a"] * 5000,
            np.zeros(5000),
            np.ones(5000, bool),
        ),
        LocalizerConfig(),
        MapConfig(),
        topoloc.BuildConfig(),
        topoloc.TrackerConfig(),
        LOCALIZED,
        LONG,
        topoloc.Alternative(IDENTITY, 0.5, topomap.summaries[0].node_id, tile="a" * 60),
        topoloc.Provenance("0" * 16, 1, "surf", 0, CAMERA, "tile", IDENTITY, "world", IDENTITY),
        MANY[0],
        topoloc.Evaluation(MANY),
        topoloc.Trace(),
        topoloc.StreamedPose(0, "tracked", LOCALIZED, IDENTITY, np.eye(6), False),
        topoloc.SlamResult([[IDENTITY] * 10_000], [], 1, 1, 1, 1, 0, [0.0], np.zeros(10_000)),
        topomap,
        topomap.nodes[0],
        topoloc.Localizer(topomap),
    ]


def test_every_public_object_is_one_line(room_map: Path):
    for one in _objects(room_map):
        text = repr(one)
        assert text.startswith(type(one).__name__) or " object at " in text
        assert "\n" not in text
        assert len(text) < 200, text


def test_the_line_shows_the_content():
    assert repr(topoloc.Evaluation(MANY)) == "Evaluation(answers=list of 10000)"
    assert repr(topoloc.Evaluation([])) == "Evaluation(answers=[])"
    assert "depth=ndarray of 400" in repr(
        topoloc.DepthImage(np.zeros((400, 640), np.float32), CAMERA)
    )
    assert "result=Localization(Rigid3(translation (0, 0, 0) m" in repr(MANY[0])


def test_a_result_in_a_notebook_is_short():
    text = LOCALIZED._repr_html_()
    for shown in ("translation (0, 0, 0) m", "sigma", "p 1.000", "20 inliers of 30 matches"):
        assert shown in text
    odd = topoloc.NotLocalized("ambiguous", detail="<b>")
    assert "ambiguous: &lt;b&gt;" in odd._repr_html_()
    several = topoloc.Alternative(topoloc.Rigid3.identity(), 0.25, LOCALIZED.node_id)
    many = topoloc.NotLocalized("ambiguous", alternatives=(several,) * 500)
    assert "0.25" in many._repr_html_()
    for result in (LOCALIZED, LONG, many):
        assert len(result._repr_html_()) < 5000


def test_a_type_checker_tells_results_and_frames_apart(tmp_path: Path):
    """`localized` is a literal of each class. pyright narrows by `is True`, not by truthiness."""
    (tmp_path / "a.py").write_text(PROGRAM)
    (tmp_path / "pyrightconfig.json").write_text("{}")
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "a.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    types = re.findall(r'Type of "[^"]*" is "(\w+)"', done.stdout)
    assert types == ["Localization", "NotLocalized", "StereoSequence", "StereoFrame"], done.stdout
    errors = re.findall(r"a\.py:(\d+):\d+ - error", done.stdout)
    assert sorted(set(errors)) == ["11", "12"]


def test_no_other_public_dataclass_prints_its_data():
    """A new dataclass inherits `OneLine`, has its own line, or holds a few numbers and
    joins this list."""
    small = "AtlasConfig GeoPoint GeoPositionPrior Illumination PoseConventions SingleMap"
    generated = {
        name
        for name in topoloc.__all__
        if dataclasses.is_dataclass(one := getattr(topoloc, name))
        and one.__dataclass_params__.repr
        and "def __repr__" not in inspect.getsource(one)
    }
    assert generated <= {*small.split(), "TrackerConfig", "UncalibratedCamera"}
    assert generated
