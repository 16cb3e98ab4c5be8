"""Test `topoloc train`: a map gets a learned coarse localizer and uses it, and
errors are one line."""

from __future__ import annotations

import json
import os
import shutil
import site
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import topoloc
from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import NewTile, create_atlas
from topoloc.mapping.storage.map_reading import list_coarse_models
from topoloc.mapping.topomap import TopoMetricMap
from topoloc_training.backbones import Backbone

SETTINGS = """
[train]
cnn_nn.picture = {width_px = 64, height_px = 48}
cnn_fc.picture = {width_px = 64, height_px = 48}
cnn_fc.training.max_epochs = 1
"""


@pytest.fixture(scope="session")
def weights_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "squeezenet.pth"
    torch.save(Backbone("squeezenet1_1", num_outputs=None).state_dict(), path)
    return path


@pytest.fixture
def small(tmp_path: Path) -> tuple[str, ...]:
    """Return settings for small images and one epoch."""
    path = tmp_path / "small.toml"
    path.write_text(SETTINGS)
    return ("--config", str(path))


@pytest.fixture
def copied_map(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


def test_a_map_is_trained_and_queried(
    copied_map: Path,
    small: tuple[str, ...],
    queries: Path,
    weights_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    before = TopoMetricMap.load(copied_map)
    facts = tmp_path / "facts.json"
    assert (
        main(
            [
                "train",
                str(copied_map),
                "--coarse",
                "cnn-nn",
                "--weights",
                str(weights_file),
                *small,
                "--json",
                str(facts),
            ]
        )
        == 0
    )
    written = json.loads(facts.read_text())
    assert written["weights"]["file"] == "squeezenet.pth"
    after = TopoMetricMap.load(copied_map)
    assert (sorted(after.first_layer.coarse_models), after.default_coarse) == (
        ["cnn-nn", "surf-vlad"],
        "surf-vlad",
    )
    assert after.nodes[0].template_image == before.nodes[0].template_image
    assert (
        main(
            ["evaluate", str(copied_map), str(queries), "--coarse", "cnn-nn", "--json", str(facts)]
        )
        == 0
    )
    evaluation = json.loads(facts.read_text())
    assert evaluation["num_localized"] >= 0.8 * evaluation["num_queries"]
    assert evaluation["topological_accuracy"] <= evaluation["neighbour_accuracy"] <= 1.0
    capsys.readouterr()
    assert main(["info", str(copied_map)]) == 0
    printed = capsys.readouterr().out
    assert (
        f"cnn-nn, squeezenet1_1 (squeezenet.pth, SHA-256 {written['weights']['sha256'][:12]})"
        in printed
    )
    assert "surf-vlad (default)" in printed


def test_the_default_changes_on_request_and_the_map_can_stay(
    copied_map: Path, small: tuple[str, ...], weights_file: Path, tmp_path: Path
):
    data, out = copied_map.read_bytes(), tmp_path / "new.topo"
    options = ("--weights", str(weights_file), *small, "--default", "--out", str(out))
    assert main(["train", str(copied_map), "--coarse", "cnn-nn", *options]) == 0
    assert copied_map.read_bytes() == data
    assert TopoMetricMap.load(out).default_coarse == "cnn-nn"
    size = out.stat().st_size
    assert (
        main(["train", str(out), "--coarse", "cnn-nn", "--weights", str(weights_file), *small]) == 0
    )
    assert abs(out.stat().st_size - size) < 20_000  # replaced, not added once more
    assert TopoMetricMap.load(out).default_coarse == "cnn-nn"


def test_cnn_fc_needs_no_weights_and_warns(
    copied_map: Path, small: tuple[str, ...], capsys: pytest.CaptureFixture[str]
):
    assert (
        main(
            [
                "train",
                str(copied_map),
                "--coarse",
                "cnn-fc",
                "--backbone",
                "compact",
                "--weights",
                "scratch",
                *small,
            ]
        )
        == 0
    )
    assert "knows these images alone" in capsys.readouterr().err
    facts, *_ = list_coarse_models(copied_map)
    assert facts["trained"]["epochs"] == 1
    assert facts["weights"] is None


def test_known_failures_are_one_line(
    copied_map: Path, weights_file: Path, queries: Path, complaint: Callable[..., str]
):
    train = ("train", copied_map, "--coarse", "cnn-nn")
    assert "looks like squeezenet1_1" in complaint(
        *train, "--backbone", "vgg16", "--weights", weights_file
    )
    assert "cannot read weights" in complaint(*train, "--weights", "none.pth")
    assert "--checkpoint is for cnn-fc" in complaint(*train, "--checkpoint", "x.ckpt", status=2)
    assert "is not a topoloc map" in complaint("train", weights_file, "--coarse", "cnn-nn")
    assert "no coarse localizer 'vlad-nn' (it has: surf-vlad)" in complaint(
        "localize", copied_map, queries, "--coarse", "vlad-nn"
    )


_PLAIN = "import sys; from topoloc.apps.cli import main; sys.exit(main(sys.argv[1:]))"
_WITHOUT_TORCH = """
import sys
class Barred:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Barred())
from topoloc.apps.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def without_training(tmp_path: Path) -> dict[str, str]:
    """Return the environment of a Python that has all packages of this one but topoloc-training."""
    packages = tmp_path / "packages"
    packages.mkdir()
    for path in map(Path, site.getsitepackages()):
        for entry in path.iterdir():
            if not entry.name.startswith("topoloc_training"):
                (packages / entry.name).symlink_to(entry)
    source = Path(str(topoloc.__file__)).parents[1]
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(source), str(packages)])}


@pytest.mark.parametrize("missing", ["torch", "topoloc-training"])
def test_what_a_trained_localizer_lacks_is_named(
    missing: str,
    copied_map: Path,
    queries: Path,
    small: tuple[str, ...],
    weights_file: Path,
    without_training: dict[str, str],
):
    train = ("train", str(copied_map), "--coarse", "cnn-nn", "--weights", str(weights_file))
    assert main([*train, "--default", *small]) == 0
    how = {
        "torch": ((), _WITHOUT_TORCH, os.environ),
        "topoloc-training": (("-S",), _PLAIN, without_training),
    }
    options, code, environment = how[missing]

    def topoloc_without(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *options, "-c", code, *words],
            capture_output=True,
            text=True,
            env=dict(environment),
            timeout=120,
            check=False,
        )

    answer = topoloc_without("localize", str(copied_map), str(queries))
    remedy = "pip install . ./training (in topoloc's source folder)"
    assert answer.stderr == f"error: the coarse localizer 'cnn-nn' needs {missing}: {remedy}\n"
    assert answer.returncode == 1
    own = topoloc_without("localize", str(copied_map), str(queries), "--coarse", "surf-vlad")
    assert own.returncode == 0, own.stderr
    assert " at " in own.stdout


def test_mapping_and_queries_with_surf_vlad_load_no_torch(copied_map: Path, queries: Path):
    code = (
        "import sys; from topoloc.apps.cli import main; main(sys.argv[1:]); print('torch' in"
        " sys.modules)"
    )
    command = [sys.executable, "-c", code, "localize", str(copied_map), str(queries)]
    answer = subprocess.run(
        command, capture_output=True, text=True, env=dict(os.environ), timeout=120, check=False
    )
    assert answer.stdout.splitlines()[-1] == "False", answer.stderr


def test_a_tile_of_an_atlas_learns_alone(
    copied_map: Path,
    small: tuple[str, ...],
    weights_file: Path,
    tmp_path: Path,
    complaint: Callable[..., str],
):
    campus = str(tmp_path / "campus")
    create_atlas(campus, [NewTile(name, copied_map, name) for name in ("room", "hall")])
    words = ("train", campus, "--coarse", "cnn-nn", "--weights", str(weights_file), *small)
    assert main([*words, "--tile", "hall"]) == 0
    atlas = Atlas.open(campus)
    known = {
        tile.tile_id: sorted(TopoMetricMap.load(atlas.map_path(tile)).first_layer.coarse_models)
        for tile in atlas.manifest.tiles
    }
    assert known == {"room": ["surf-vlad"], "hall": ["cnn-nn", "surf-vlad"]}
    assert "select a tile with --tile" in complaint(*words, status=2)
    assert "--out needs a map file" in complaint(
        *words, "--tile", "hall", "--out", str(tmp_path / "out.topo"), status=2
    )
