"""Check that the public names do the work of the commands, given paths."""

from __future__ import annotations

import ast
import builtins
import inspect
import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import topoloc
import topoloc.plugin
from topoloc import errors
from topoloc.apps import core_names
from topoloc.demo.recordings import SHIPPED

CORE_NAMES = Path(core_names.__file__).with_suffix(".pyi")


def _docstrings() -> Iterator[tuple[str, str]]:
    for door in (topoloc, topoloc.plugin, core_names):
        for name in door.__all__:
            public = getattr(door, name)
            yield name, inspect.getdoc(public) or ""
            members = vars(public) if inspect.isclass(public) else ()
            for member in members:
                text = getattr(getattr(public, member), "__doc__", None)
                yield f"{name}.{member}", text if isinstance(text, str) else ""


def test_errors_that_public_names_raise_are_of_the_documented_tree():
    """Python's own errors are allowed, too. The page of the public names shows the tree."""
    raised = {
        error: name
        for name, text in _docstrings()
        for error in re.findall(r"\b[A-Z]\w+Error\b", text)
    }
    assert {"EmptyMapError", "UnknownFormatError", "ConfigError"} <= set(raised)
    own = {error for error in raised if not hasattr(builtins, error)}
    assert [(raised[error], error) for error in own if not hasattr(errors, error)] == []
    assert own <= set(re.findall(r"\w+Error", errors.__doc__ or ""))


def test_extensions_are_promised_few_names():
    assert 30 < len(topoloc.plugin.__all__) <= 40


@pytest.mark.parametrize("door", [topoloc, topoloc.plugin, core_names], ids=lambda m: m.__name__)
def test_the_names_of_a_stub_are_those_of_its_module(door: ModuleType):
    stub = Path(door.__file__ or "").with_suffix(".pyi").read_text(encoding="utf-8")
    listed = set(re.findall(r"\b(\w+) as \1\b", stub)) | set(re.findall(r"^(__v\w+):", stub, re.M))
    assert listed == set(door.__all__)
    for name in door.__all__:
        assert getattr(door, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nowhere'"):
        _ = door.nowhere


def test_applications_use_each_name_that_is_theirs_alone():
    """And no name of it is public, too."""
    apps = CORE_NAMES.parent.rglob("*.py")
    used = {
        name
        for path in apps
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        for name in _names_of_core(node)
    }
    assert used == set(core_names.__all__)
    assert used & {*topoloc.__all__, *topoloc.plugin.__all__} == set()


def _names_of_core(node: ast.AST) -> list[str]:
    """Return the names of `core_names` that a statement imports or an expression reads."""
    if isinstance(node, ast.ImportFrom) and node.module == "topoloc.apps.core_names":
        return [alias.name for alias in node.names]
    if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "core_names":
        return [node.attr]
    return []


@pytest.mark.parametrize(
    "name", ["build_map", "run_slam", "evaluate", "certify", "update", "merge"]
)
def test_long_calls_report_their_progress(name: str):
    assert "progress" in inspect.signature(getattr(topoloc, name)).parameters


def test_progress_names_the_stages_and_counts_to_the_end(lab_map: Path):
    told = list[tuple[str, int, int]]()
    recording = topoloc.open_sequence(SHIPPED / "map_lap1")[:8]
    topoloc.build_map(recording, progress=lambda *step: told.append(step))
    topoloc.evaluate(
        topoloc.Localizer(lab_map), [recording[:2]], progress=lambda *step: told.append(step)
    )
    last = {stage: (done, total) for stage, done, total in told}
    assert {"nodes", "repetitions", "map_lap1"} <= set(last)
    assert all(done == total for done, total in last.values())


@pytest.fixture(scope="module")
def lab_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lab") / "lab.topo"
    topoloc.build_map(topoloc.open_sequence(SHIPPED / "map_lap1")[0:30]).save(path)
    return path


def test_a_map_is_built_and_localized_in_by_paths(lab_map: Path):
    frame = topoloc.open_sequence(SHIPPED / "map_lap1")[10]
    localizer = topoloc.Localizer(str(lab_map))
    result = localizer.localize(frame.image, frame.camera)
    assert isinstance(result, topoloc.Localization)
    assert frame.world_from_cam is not None
    error = result.world_from_cam.translation - frame.world_from_cam.translation
    assert abs(error).max() < 0.05


def test_a_slice_makes_the_map_of_its_frames(lab_map: Path):
    recording = topoloc.open_sequence(SHIPPED / "map_lap1")
    with topoloc.TopoMetricMap.load(lab_map) as whole:
        assert whole.sessions[0].end_ns <= recording.t_ns[29]
    part = topoloc.build_map(recording[0:30:2][5:10])
    assert {node.summary.name for node in part.nodes} <= set(recording.names[10:20:2])
    assert part.sessions[0].poses_from == "truth"
    with pytest.raises(topoloc.RecordingError, match="map_lap1: no frames"):
        topoloc.build_map(recording[5:5])


def test_a_map_is_evaluated(lab_map: Path):
    known = topoloc.open_sequence(f"{SHIPPED / 'map_lap1'}@1:20:6")
    other = topoloc.open_sequence(f"{SHIPPED / 'corridor'}@0:2")
    evaluation = topoloc.evaluate(topoloc.Localizer(lab_map), [known], [other])
    figures = evaluation.to_json()
    assert figures["num_queries"] == figures["num_localized"] == len(known)
    assert (figures["num_elsewhere"], figures["false_accepts"]) == (len(other), 0)
    assert list(evaluation.by_recording) == [known.name, other.name]
    assert evaluation.world_fits == []


def test_a_map_file_is_edited_and_the_edits_undone(lab_map: Path, tmp_path: Path):
    path = tmp_path / "lab.topo"
    path.write_bytes(lab_map.read_bytes())
    size = path.stat().st_size
    pruned = topoloc.prune(path, max_mb=0.8 * size / 1e6)
    assert pruned.changes["bytes"] == path.stat().st_size < size
    topoloc.georeference(path, origin=(topoloc.GeoPoint(48.1, 11.6, 520.0), 90.0))
    assert [edit["undoable"] for edit in topoloc.read_history(path)][-2:] == [True, True]
    assert topoloc.check_map(path) == []
    for _ in range(2):
        topoloc.undo_edit(path)
    assert path.read_bytes() == lab_map.read_bytes()
    with pytest.raises(ValueError, match="one of origin, gnss and points"):
        topoloc.georeference(path)


def test_a_recording_joins_a_map_once(lab_map: Path, tmp_path: Path):
    path = tmp_path / "lab.topo"
    path.write_bytes(lab_map.read_bytes())
    updated = topoloc.update(path, f"{SHIPPED / 'map_lap2'}@0:12", light="morning")
    assert updated.changes["session"] == 2 or updated.changes["session"] == 1
    with topoloc.TopoMetricMap.load(path) as topomap:
        assert topomap.sessions[-1].light_name == "morning"
    with pytest.raises(topoloc.DuplicateSessionError):
        topoloc.update(path, f"{SHIPPED / 'map_lap2'}@0:12")


def test_a_map_is_exported_and_viewed(lab_map: Path, tmp_path: Path):
    topoloc.export(lab_map, tmp_path / "points.ply")
    topoloc.view(lab_map, tmp_path / "lab.html")
    assert (tmp_path / "points.ply").read_bytes().startswith(b"ply")
    assert "</html>" in (tmp_path / "lab.html").read_text(encoding="utf-8")


def test_an_atlas_is_made_of_map_files(lab_map: Path, tmp_path: Path):
    where = str(tmp_path / "campus")
    assert topoloc.Atlas.create(where, [str(lab_map)]).find_problem("lab") is None
    atlas = topoloc.Atlas.add(where, [str(lab_map)], tile_id="again", world="lab")
    assert list(atlas.manifest.by_id) == ["again", "lab"]
    assert topoloc.open_place(where).select_tiles() == ["again", "lab"]
    assert topoloc.Atlas.remove(where, ["again"]).history("lab")[0]["edit_id"] == 1
    with pytest.raises(topoloc.AtlasError, match="no tile"):
        atlas.find_problem("cellar")


def _path_parameters() -> Iterator[tuple[str, str]]:
    """Return the parameters of public functions and methods that take a path, and their types."""
    for name in topoloc.__all__:
        public = getattr(topoloc, name)
        members = [f"{name}.{one}" for one in vars(public)] if inspect.isclass(public) else [name]
        for path in members:
            member = getattr(public, path.rpartition(".")[2]) if "." in path else public
            if not inspect.isfunction(member) or path.rpartition(".")[2].startswith("_"):
                continue
            for parameter in inspect.signature(inspect.unwrap(member)).parameters.values():
                if re.search(r"(^|[^\[])\bPath\b(?!\])", str(parameter.annotation)):
                    yield f"{path}({parameter.name})", str(parameter.annotation)


def test_paths_may_be_texts():
    accepted = dict(_path_parameters())
    assert len(accepted) > 20
    assert [name for name, kind in accepted.items() if not re.search(r"\bstr\b|Input", kind)] == []


def test_images_and_trajectories_are_read_from_texts(tmp_path: Path):
    day = str(SHIPPED / "day")
    image = topoloc.read_image(f"{day}/images/{sorted(os.listdir(f'{day}/images'))[0]}")
    assert image.shape[:2] == (400, 640)
    truth = topoloc.Trajectory.read(f"{day}/truth.tum")
    truth.write_tum(str(tmp_path / "poses.tum"))
    assert len(topoloc.Trajectory.read(str(tmp_path / "poses.tum"))) == len(truth)
    posed = topoloc.with_trajectory(topoloc.open_sequence(day), f"{day}/truth.tum")
    assert any(pose is not None for pose in posed.poses)
    aligned = topoloc.align_to_trajectory(posed, f"{day}/truth.tum")
    assert len(aligned) == len(posed)
