"""Check that an atlas built on a cluster of two nodes has the same maps, even if
workers are killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from logging_maker import LoggingMaker

from topoloc.apps.cli import main
from topoloc.apps.cli.mapping.map_jobs import MapJob, PoseOptions
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.tasks import JobProgress
from topoloc.apps.cluster.tiles import Outcome, TileJob, build_on_ray
from topoloc.atlas.atlas import Atlas
from topoloc.mapping.build import BuildConfig

Complaint = Callable[..., str]


@pytest.fixture(scope="module")
def one_by_one(walks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the bytes of each recording's map, built by the plain command."""
    folder = tmp_path_factory.mktemp("alone")
    for walk in walks:
        assert main(["build", str(walk), str(folder / f"{walk.name}.topo")]) == 0
    return {walk.name: (folder / f"{walk.name}.topo").read_bytes() for walk in walks}


def _maps(where: str) -> dict[str, bytes]:
    atlas = Atlas.open(where)
    assert [
        atlas.find_problem(tile.tile_id)
        for tile in atlas.manifest.tiles
        if atlas.find_problem(tile.tile_id)
    ] == []
    return {tile.tile_id: atlas.map_path(tile).read_bytes() for tile in atlas.manifest.tiles}


def _litter(atlas: Path, scratch: Path) -> list[str]:
    """Return files that no manifest names, and files that workers left."""
    named = Atlas.open(str(atlas)).manifest.files | {"atlas.json", ".atlas.lock"}
    found = {path.relative_to(atlas).as_posix() for path in atlas.rglob("*") if path.is_file()}
    return sorted(found - named) + [path.name for path in scratch.rglob("*topoloc*")]


def _built(capsys: pytest.CaptureFixture[str], status: int, *args: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["build", *(str(arg) for arg in args), "--json", "-"]) == status
    return json.loads(capsys.readouterr().out)


def _states(built: dict[str, Any]) -> list[str]:
    return [recording["state"] for recording in built["recordings"]]


def test_the_same_maps_as_one_by_one(
    cluster: Any,
    walks: list[Path],
    one_by_one: dict[str, bytes],
    scratch: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    """A recording without a map is reported and skipped. Existing maps are not built again."""
    atlas, broken = tmp_path / "campus", tmp_path / "broken"
    broken.mkdir()
    built = _built(capsys, 1, walks[0], broken, *walks[1:], atlas, "--ray", cluster.address)
    assert _states(built) == ["built", "failed", "built", "built"]
    assert "no known recording" in built["recordings"][1]["reason"]
    assert _maps(str(atlas)) == one_by_one
    before = (atlas / "atlas.json").read_bytes()
    again = _built(capsys, 0, *walks, atlas, "--ray", cluster.address)
    assert _states(again) == ["there"] * 3
    assert (atlas / "atlas.json").read_bytes() == before
    assert _litter(atlas, scratch) == []


def test_a_ray_of_another_version(
    cluster: Any,
    walks: list[Path],
    tmp_path: Path,
    complaint: Complaint,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("ray.__version__", "1.0.0")
    assert "has another version" in complaint(
        "build", walks[0], tmp_path / "campus", "--ray", cluster.address
    )


def _jobs(walks: list[Path], log: Path, seconds: float) -> list[TileJob]:
    def maker(walk: Path) -> LoggingMaker:
        return LoggingMaker(
            MapJob((str(walk),), PoseOptions(), BuildConfig()),
            str(log),
            walk.name,
            seconds,
        )

    return [TileJob(str(walk), walk.name, walk.name, maker(walk)) for walk in walks]


def _lines(log: Path) -> list[list[str]]:
    return [line.split() for line in log.read_text().splitlines()] if log.exists() else []


def _wait_for(condition: Callable[[], Any], seconds: float = 180.0) -> Any:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError("it never came")


def _in_background(*args: Any, **options: Any) -> tuple[threading.Thread, list[Outcome]]:
    outcomes: list[Outcome] = []
    thread = threading.Thread(target=lambda: outcomes.extend(build_on_ray(*args, **options)))
    thread.start()
    return thread, outcomes


@pytest.mark.slow
def test_a_worker_that_is_killed_is_begun_again(
    cluster: Any, walks: list[Path], one_by_one: dict[str, bytes], scratch: Path, tmp_path: Path
):
    log, atlas = tmp_path / "log", tmp_path / "campus"
    thread, outcomes = _in_background(_jobs(walks, log, 2.0), str(atlas), cluster.address)
    _, killed, pid, _ = _wait_for(lambda: _lines(log))[0]
    os.kill(int(pid), signal.SIGKILL)
    thread.join()
    assert [outcome.reason for outcome in outcomes] == [None] * 3
    assert _maps(str(atlas)) == one_by_one
    begun = [name for what, name, *_ in _lines(log) if what == "begin"]
    assert sorted(begun) == sorted([killed, *(walk.name for walk in walks)])
    assert _litter(atlas, scratch) == []


@pytest.mark.slow
def test_a_worker_that_dies_each_time_is_a_failure_of_its_recording(
    cluster: Any, walks: list[Path], tmp_path: Path
):
    log, atlas = tmp_path / "log", tmp_path / "campus"
    jobs, config = _jobs(walks[:2], log, 2.0), ClusterConfig(max_retries=0)
    thread, outcomes = _in_background(jobs, str(atlas), cluster.address, config=config)
    _, killed, pid, _ = _wait_for(lambda: _lines(log))[0]
    os.kill(int(pid), signal.SIGKILL)
    thread.join()
    assert {outcome.tile_id: outcome.state for outcome in outcomes} == {
        walk.name: "built" for walk in walks[:2]
    } | {killed: "failed"}
    assert "its worker ended" in str(next(outcome.reason for outcome in outcomes if outcome.reason))


@pytest.mark.slow
def test_a_node_that_goes_away(
    cluster: Any, walks: list[Path], one_by_one: dict[str, bytes], scratch: Path, tmp_path: Path
):
    log, atlas = tmp_path / "log", tmp_path / "campus"
    head = cluster.head_node.node_id
    thread, outcomes = _in_background(_jobs(walks, log, 3.0), str(atlas), cluster.address)
    _, lost, *_ = _wait_for(lambda: [line for line in _lines(log) if line[3] != head])[0]
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    thread.join()
    cluster.add_node(num_cpus=1)
    assert [outcome.reason for outcome in outcomes] == [None] * 3
    assert _maps(str(atlas)) == one_by_one
    begun = [name for what, name, *_ in _lines(log) if what == "begin"]
    assert begun.count(lost) == 2
    assert len(begun) == 4
    assert _litter(atlas, scratch) == []


@pytest.mark.slow
def test_a_driver_that_is_killed_goes_on_where_it_was(
    cluster: Any,
    walks: list[Path],
    one_by_one: dict[str, bytes],
    scratch: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    atlas = tmp_path / "campus"
    args = [*map(str, walks), str(atlas), "--ray", cluster.address]
    driver = subprocess.Popen(
        [sys.executable, "-m", "topoloc", "build", *args],
        env={**os.environ, "TMPDIR": str(scratch)},
    )
    _wait_for((atlas / "atlas.json").exists)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    whole = _maps(str(atlas))
    assert 0 < len(whole) < 3
    time_of = {
        name: stored.stat().st_mtime_ns
        for name in whole
        for stored in (atlas / "tiles").glob(f"{name}-*.topo")
    }
    built = _built(capsys, 0, *args)
    states = {recording["tile_id"]: recording["state"] for recording in built["recordings"]}
    assert {name for name, state in states.items() if state == "there"} >= set(whole)
    assert _maps(str(atlas)) == one_by_one
    assert {
        name: stored.stat().st_mtime_ns
        for name in whole
        for stored in (atlas / "tiles").glob(f"{name}-*.topo")
    } == time_of
    assert _litter(atlas, scratch) == []


@pytest.mark.slow
def test_an_atlas_in_an_object_store(
    cluster: Any,
    walks: list[Path],
    one_by_one: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """A store of local files stands in for an object store. It creates folders in the same way."""
    pytest.importorskip("obstore", reason="obstore is not installed (the extra cluster)")
    where = f"file://{tmp_path}/bucket/campus"
    jobs = _jobs(walks, tmp_path / "log", 0.0)
    seen: list[tuple[int, Outcome | JobProgress]] = []
    outcomes = build_on_ray(
        jobs,
        where,
        cluster.address,
        show=lambda number, state: seen.append((number, state)),
        is_live=True,
    )
    assert [outcome.reason for outcome in outcomes] == [None] * 3
    assert _maps(where) == one_by_one
    assert {number for number, state in seen if isinstance(state, Outcome)} == {0, 1, 2}
    assert any(
        isinstance(state, JobProgress) and 0 < state.done <= state.total for _, state in seen
    )


@pytest.mark.slow
def test_a_cluster_of_this_machine_ends_with_the_command(walks: list[Path], tmp_path: Path):
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    scratch = Path(tempfile.mkdtemp(prefix="rt-"))  # short: sockets lie in it
    command = [
        sys.executable,
        "-m",
        "topoloc",
        "build",
        *map(str, walks),
        str(tmp_path / "campus"),
        "--ray",
        "local",
    ]
    environment = {**os.environ, "TMPDIR": str(scratch)}
    try:
        driver = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        _wait_for((tmp_path / "campus" / "atlas.json").exists)
        driver.send_signal(signal.SIGTERM)
        said = driver.communicate(timeout=60)[1]
        assert (driver.returncode, said.splitlines()[-1]) == (
            1,
            "error: interrupted; no file is incomplete",
        )
        assert list(scratch.glob("topoloc*")) == []
        assert subprocess.run(command, env=environment, capture_output=True).returncode == 0
        assert [tile.tile_id for tile in Atlas.open(str(tmp_path / "campus")).manifest.tiles] == [
            walk.name for walk in walks
        ]
        assert [path for path in scratch.iterdir() if "topoloc" in path.name] == []
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
