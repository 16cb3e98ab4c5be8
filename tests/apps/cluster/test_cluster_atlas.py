"""Check that a cluster of two nodes joins and updates tiles exactly as one machine does."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tiny_world import write_stereo_recording
from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import create_atlas, new_tiles, remove_tiles
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an atlas of two pieces of one walk, which share three pairs, and another
    room. Read-only."""
    folder = tmp_path_factory.mktemp("pieces")
    walk = write_stereo_recording(folder / "walk", 1, [float(k) for k in range(9)])
    other = write_stereo_recording(folder / "other", 3, [0.0, 2.0, 4.0, 6.0, 8.0])
    recordings = {"first": f"{walk}@0:6", "second": f"{walk}@3:9", "other": str(other)}
    for name, recording in recordings.items():
        build_map(open_sequence(recording), BuildConfig(other_kinds=())).save(
            folder / f"{name}.topo"
        )
    create_atlas(
        str(folder / "campus"), new_tiles([str(folder / f"{name}.topo") for name in recordings])
    )
    return folder / "campus"


def _said(capsys: pytest.CaptureFixture[str], status: int, *args: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*map(str, args), "--json", "-"]) == status
    return json.loads(capsys.readouterr().out)


def _manifest(where: Path) -> dict[str, Any]:
    """Return the manifest without its serial number and the times of retired files."""
    data = json.loads((where / "atlas.json").read_bytes())
    return data | {"serial": 0, "retired": sorted(data["retired"])}


def _maps(where: Path) -> dict[str, bytes]:
    atlas = Atlas.open(str(where))
    assert [atlas.find_problem(tile.tile_id) for tile in atlas.manifest.tiles] == [None] * len(
        atlas.manifest.tiles
    )
    return {tile.tile_id: atlas.map_path(tile).read_bytes() for tile in atlas.manifest.tiles}


def test_pairs_are_joined_as_on_one_machine(
    cluster: Any, pieces: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Joined pairs are not compared again, so that a killed driver can continue."""
    settings = tmp_path / "all.toml"
    settings.write_text(
        "[join]\nmin_likeness = -1.0\nnum_probed = 2\n"
    )  # the other room is compared, too
    alone, shared = (Path(shutil.copytree(pieces, tmp_path / name)) for name in ("alone", "shared"))
    expected = _said(capsys, 0, "atlas", "join", alone, "--config", settings)
    found = _said(
        capsys, 0, "atlas", "join", shared, "--config", settings, "--ray", cluster.address
    )
    assert len(found["tried"]) == 3
    assert [(one["first"], one["second"]) for one in found["tried"] if one["joined"]] == [
        ("first", "second")
    ]
    assert found["tried"] == expected["tried"]
    assert _manifest(shared) == _manifest(alone)
    before = (shared / "atlas.json").read_bytes()
    again = _said(
        capsys, 0, "atlas", "join", shared, "--config", settings, "--ray", cluster.address
    )
    assert [one["joined"] for one in again["tried"]] == [False, False]
    assert (shared / "atlas.json").read_bytes() == before


def test_a_pair_whose_worker_ended_is_a_failure(
    pieces: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    """The pair is a failure, not a refusal. The results of other pairs stay."""
    import topoloc.apps.cluster.tasks as tasks

    def half_lost(jobs: Any, address: str, *args: object) -> list[Any]:
        return [
            job.failure_outcome("its worker ended: killed") if number else job.run(lambda *_: None)
            for number, job in enumerate(jobs)
        ]

    monkeypatch.setattr(tasks, "run_on_ray", half_lost)
    campus = shutil.copytree(pieces, tmp_path / "campus")
    settings = tmp_path / "two.toml"
    settings.write_text("[join]\nmin_likeness = -1.0\nmax_pairs = 2\n")
    assert main(["atlas", "join", str(campus), "--config", str(settings), "--ray", "auto"]) == 1
    said = capsys.readouterr()
    assert said.err.splitlines()[-1].startswith("error: ")
    assert said.err.endswith("its worker ended: killed\n")
    assert "join   first and second" in said.out


def test_recordings_join_their_tiles_as_on_one_machine(
    cluster: Any,
    pieces: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    """Two recordings of one tile run in order, one of another tile in parallel. One shows
    another place."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    rows = {
        "noon": (1, 0.3, 8.3),
        "late": (3, 0.3, 7.3),
        "night": (1, 0.4, 8.4),
        "nowhere": (5, 0.0, 5.0),
    }
    recordings = [
        write_stereo_recording(
            tmp_path / name, seed, [start + (stop - start) * k / 15 for k in range(16)]
        )
        for name, (seed, start, stop) in rows.items()
    ]
    alone, shared = (Path(shutil.copytree(pieces, tmp_path / name)) for name in ("alone", "shared"))
    for where in (alone, shared):
        remove_tiles(str(where), ["second"])  # of the same room
    _said(capsys, 1, "update", alone, *recordings)
    found = _said(capsys, 1, "update", shared, *recordings, "--ray", cluster.address)
    states = [(one["state"], one["tile_id"]) for one in found["recordings"]]
    assert states == [
        ("updated", "first"),
        ("updated", "other"),
        ("updated", "first"),
        ("failed", ""),
    ]
    assert [one["changes"]["session"] for one in found["recordings"] if "changes" in one] == [
        1,
        1,
        2,
    ]
    assert _maps(shared) == _maps(alone)
    assert _manifest(shared)["tiles"] == _manifest(alone)["tiles"]
    before = (shared / "atlas.json").read_bytes()
    again = _said(capsys, 0, "update", shared, *recordings[:3], "--ray", cluster.address)
    assert [one["state"] for one in again["recordings"]] == ["there"] * 3
    assert (shared / "atlas.json").read_bytes() == before
