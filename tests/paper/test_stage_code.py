"""Check that a stage runs again after a change of code that its result depends on, and of
no other code."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from topoloc.retrieval.coarse import COARSE_NAMES
from topoloc_paper import stage_code
from topoloc_paper.peers import _CODE
from topoloc_paper.posenet_baseline import _CODE as POSENET
from topoloc_paper.stage_code import (
    COARSE_MODULES,
    MAPPING,
    ROOTS,
    StageCode,
    _file,
    answering,
    asking,
    learning,
)

LEARNING = {
    f"learning {name}": learning(module)
    for name, module in COARSE_MODULES.items()
    if name != "surf-vlad"
}
STAGES: dict[str, StageCode] = {
    "mapping": MAPPING,
    "asking surf-vlad": asking("surf-vlad"),
    "asking cnn-nn": asking("cnn-nn"),
    **LEARNING,
    "learning PoseNet": POSENET,
    **{peer: answering(*modules) for peer, modules in _CODE.items()},
}
ASKING, PEERS = {"asking surf-vlad", "asking cnn-nn"}, set(_CODE)


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the program that a test may change."""
    for package, root in ROOTS.items():
        shutil.copytree(
            root / package,
            tmp_path / package,
            ignore=lambda folder, names: [n for n in names if Path(n).suffix not in (".py", "")],
        )
        monkeypatch.setitem(ROOTS, package, tmp_path)
    for reading in _READ:
        monkeypatch.setattr(stage_code, reading, None)  # as it was, afterwards
    _forget()
    return tmp_path


_READ = {"_imports": stage_code._imports.__wrapped__, "_meaning": stage_code._meaning.__wrapped__}


@functools.cache
def _of_content(reading: str, module: str, content: bytes) -> object:
    """Return the reading of a module, cached for all tests that leave it unchanged."""
    return _READ[reading](module)


def _forget() -> None:
    """Read each file again, but keep the trees of unchanged files."""
    for reading in _READ:

        @functools.cache
        def read(module: str, reading: str = reading) -> object:
            return _of_content(reading, module, _file(module).read_bytes())

        setattr(stage_code, reading, read)


def _done_again(change: Callable[[], object]) -> set[str]:
    """Return the stages whose code differs after the change."""
    before = {name: stage.digest() for name, stage in STAGES.items()}
    change()
    _forget()
    return {name for name, stage in STAGES.items() if stage.digest() != before[name]}


@pytest.mark.parametrize(
    ("module", "stages"),
    [
        ("topoloc/localization/localizer.py", ASKING),
        ("topoloc/localization/evidence.py", ASKING),
        ("topoloc/geometry/pose_matches.py", ASKING),
        ("topoloc/tracking/tracker.py", set()),
        ("topoloc/slam/odometry.py", set()),
        ("topoloc/evaluation/metrics.py", set()),
        ("topoloc_paper/tables.py", set()),
        ("topoloc/errors.py", set()),
        ("topoloc/retrieval/vlad.py", {"mapping", *ASKING, *PEERS}),
        ("topoloc_training/cnn_nn.py", {"asking cnn-nn", "learning cnn-nn"}),
        ("topoloc_training/training.py", {"learning cnn-fc", "learning PoseNet"}),
        ("topoloc_training/coarse_training.py", {*LEARNING, "learning PoseNet"}),
        ("topoloc/mapping/landmarks.py", {"mapping"}),
        ("topoloc/mapping/storage/map_reading.py", {"mapping", *ASKING, *PEERS}),
        ("topoloc/features/surf_descriptors.py", {"mapping", *ASKING, *PEERS}),
        ("topoloc_paper/colmap_worker.py", {"pycolmap, SIFT"}),
        ("topoloc_paper/pose_losses.py", {"learning PoseNet"}),
    ],
)
def test_stages_that_run_changed_code_are_done_again(module: str, stages: set[str], code: Path):
    path = code / module
    assert _done_again(lambda: path.write_text(path.read_text() + "\nCHANGED = 1\n")) == stages


def test_comments_and_docstrings_are_no_change(code: Path):
    path = code / "topoloc/localization/localizer.py"
    text = path.read_text()
    reworded = text.replace("section III-B of the paper", "a part of the paper", 1).replace(
        "import warnings", "import warnings  # of users", 1
    )
    assert reworded.count("# of users") == 1
    assert reworded != text.replace("import warnings", "import warnings  # of users", 1)
    assert _done_again(lambda: path.write_text(reworded)) == set()


def test_a_new_import_of_a_stage_counts(code: Path):
    path = code / "topoloc/retrieval/vlad.py"
    before = MAPPING.files()
    path.write_text(
        path.read_text().replace(
            "import numpy as np", "import numpy as np\nfrom topoloc.slam import pose_graph", 1
        )
    )
    _forget()
    assert set(MAPPING.files()) - set(before) >= {"topoloc/slam/pose_graph.py"}


def test_an_import_for_the_type_checker_alone_does_not_count(code: Path):
    path = code / "topoloc/retrieval/vlad.py"
    before = MAPPING.files()
    guarded = (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from topoloc.slam import"
        " pose_graph\n"
    )
    path.write_text(
        path.read_text().replace("import numpy as np", f"import numpy as np\n{guarded}", 1)
    )
    _forget()
    assert MAPPING.files() == before


def test_every_module_named_is_there():
    points = entry_points(group="topoloc.coarse_localizers")
    opened = {point.name: f"{point.module.replace('.', '/')}.py" for point in points}
    assert opened | {"surf-vlad": "topoloc/retrieval/vlad.py"} == COARSE_MODULES
    assert COARSE_MODULES.keys() == set(COARSE_NAMES)
    assert [
        name
        for name, stage in STAGES.items()
        if not all(_file(module).is_file() for module in stage.modules)
    ] == []
