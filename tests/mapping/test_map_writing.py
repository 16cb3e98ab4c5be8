"""Test the map file: its content is read back, it is complete or absent, and damage is detected."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc.errors import MapError, MapVersionError
from topoloc.features.feature_types import FEATURE_TYPES, SURF
from topoloc.mapping.storage import map_writing
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap


def test_everything_comes_back(tiny_map: TopoMetricMap, saved: Path):
    loaded = TopoMetricMap.load(saved)
    assert list(loaded.edges) == list(tiny_map.edges)
    assert loaded.config == tiny_map.config
    assert list(loaded.sessions) == list(tiny_map.sessions)
    assert list(loaded.edits) == list(tiny_map.edits)
    assert loaded.length_m == tiny_map.length_m
    assert loaded.first_layer.shared_errors == tiny_map.first_layer.shared_errors is not None
    assert len(loaded.nodes) == len(loaded.summaries) == len(tiny_map.nodes)
    for one, other, summary in zip(loaded.nodes, tiny_map.nodes, loaded.summaries, strict=True):
        for s in (one.summary, summary):
            assert (s.node_id, s.recording, s.name, s.t_ns, s.num_points) == (
                other.summary.node_id,
                other.summary.recording,
                other.summary.name,
                other.summary.t_ns,
                other.summary.num_points,
            )
            np.testing.assert_array_equal(
                s.world_from_cam.matrix(), other.summary.world_from_cam.matrix()
            )
        assert one.camera == other.camera
        assert one.template_image == other.template_image
        for name, rtol, atol in (
            ("points_img", 0.0, 1 / 128),
            ("sizes_px", 1 / 256, 0.0),
            ("angles", 0.0, 1 / 128),
            ("responses", 1 / 256, 0.0),
        ):
            stored, given = (getattr(node.features, name) for node in (one, other))
            np.testing.assert_allclose(stored, given, rtol=rtol, atol=atol)
        np.testing.assert_allclose(one.points_cam, other.points_cam, rtol=2**-16)
        np.testing.assert_allclose(one.point_sqrt_covs, other.point_sqrt_covs, rtol=1e-2, atol=1e-6)
    for one, other in zip(loaded.place_images, tiny_map.place_images, strict=True):
        assert (one.recording, one.name, one.node_id, one.jpeg) == (
            other.recording,
            other.name,
            other.node_id,
            other.jpeg,
        )
        np.testing.assert_array_equal(one.world_from_cam.matrix(), other.world_from_cam.matrix())


def test_descriptors_come_back_within_quantisation(tiny_map: TopoMetricMap, saved: Path):
    for one, other in zip(TopoMetricMap.load(saved).nodes, tiny_map.nodes, strict=True):
        kept = np.abs(other.features.descriptors).max(axis=1) < 127 / SURF.descriptor_scale
        assert kept.mean() > 0.95
        error = np.abs(one.features.descriptors - other.features.descriptors)
        assert (
            error[kept].max()
            < 1.5 / (2 * SURF.descriptor_scale) + 0.02 * np.abs(other.features.descriptors).max()
        )
        cosines = np.sum(one.features.descriptors * other.features.descriptors, axis=1)
        assert cosines.min() > 0.95
        assert np.median(cosines) > 0.99


def test_each_feature_type_has_its_own_quantisation(
    tiny_map: TopoMetricMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(FEATURE_TYPES, "surf", replace(SURF, descriptor_scale=100.0))
    tiny_map.save(tmp_path / "coarser.topo")
    for one, other in zip(
        TopoMetricMap.load(tmp_path / "coarser.topo").nodes, tiny_map.nodes, strict=True
    ):
        np.testing.assert_array_equal(
            one.stored_descriptors, np.rint(other.features.descriptors * 100.0)
        )


def test_covariances_come_back_positive_and_within_half_precision(
    tiny_map: TopoMetricMap, saved: Path
):
    def covariances(sqrt_covs: np.ndarray) -> np.ndarray:
        lower = np.zeros((len(sqrt_covs), 3, 3))
        lower[:, *np.tril_indices(3)] = sqrt_covs
        return lower @ lower.transpose(0, 2, 1)

    one, other = (
        covariances(m.nodes[0].point_sqrt_covs) for m in (TopoMetricMap.load(saved), tiny_map)
    )
    assert (np.linalg.eigvalsh(one)[:, 0] > 0).all()
    scale = np.sqrt(np.einsum("nii->ni", other))
    assert (np.abs(one - other) / (scale[:, :, None] * scale[:, None, :])).max() < 0.01


def stop(error: BaseException) -> Callable[..., None]:
    def raise_it(*_: object) -> None:
        raise error

    return raise_it


def _full_of_sqlite() -> sqlite3.Error:
    error = sqlite3.OperationalError("database or disk is full")
    error.sqlite_errorcode = sqlite3.SQLITE_FULL
    return error


@pytest.mark.parametrize(
    "error",
    [_full_of_sqlite(), OSError(28, "No space left on device")],
)
@pytest.mark.parametrize("there_before", [True, False])
def test_a_failed_write_leaves_the_old_map_and_nothing_else(
    tiny_map: TopoMetricMap,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    there_before: bool,
):
    path = tmp_path / "room.topo"
    if there_before:
        tiny_map.save(path)
    before = path.read_bytes() if there_before else None
    monkeypatch.setattr(
        map_writing, "compute_map_digest", stop(error)
    )  # called last, after all nodes are written
    with pytest.raises(MapError, match=r"cannot write map .*room\.topo: No space left"):
        tiny_map.save(path)
    assert (path.read_bytes() if path.exists() else None) == before
    assert list(tmp_path.iterdir()) == ([path] if there_before else [])


def test_a_disk_that_is_full_is_a_map_error(
    tiny_map: TopoMetricMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """SQLite raises its own error, because the file is limited to a few pages."""

    def small(*args, **kwargs) -> sqlite3.Connection:
        database = real(*args, **kwargs)
        database.execute("PRAGMA max_page_count = 12")
        return database

    real = sqlite3.connect
    monkeypatch.setattr(map_writing.sqlite3, "connect", small)
    with pytest.raises(MapError, match="full"):
        tiny_map.save(tmp_path / "room.topo")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_leaves_nothing(
    tiny_map: TopoMetricMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(map_writing, "compute_map_digest", stop(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        tiny_map.save(tmp_path / "room.topo")
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written_are_map_errors(tiny_map: TopoMetricMap, tmp_path: Path):
    (tmp_path / "file").write_text("")
    for path in (
        tmp_path / "missing" / "room.topo",
        tmp_path / "file" / "room.topo",
        tmp_path,
        tmp_path / ("x" * 300),
        Path(""),
    ):
        with pytest.raises(MapError, match="cannot write map") as caught:
            tiny_map.save(path)
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def with_bytes(path: Path, offset: int, data: bytes) -> Path:
    content = bytearray(path.read_bytes())
    content[offset : offset + len(data)] = data
    path.write_bytes(content)
    return path


def test_other_files_are_refused_with_their_kind(tmp_path: Path):
    with pytest.raises(MapError, match=r"cannot open map .*no\.topo: No such file"):
        TopoMetricMap.load(tmp_path / "no.topo")
    with pytest.raises(MapError, match="is no map but a folder"):
        TopoMetricMap.load(tmp_path)
    (tmp_path / "empty.topo").write_bytes(b"")
    with pytest.raises(MapError, match="the file is empty"):
        TopoMetricMap.load(tmp_path / "empty.topo")
    (tmp_path / "text.topo").write_text("SQLite, but no" * 100)
    with pytest.raises(MapError, match="is not a topoloc map"):
        TopoMetricMap.load(tmp_path / "text.topo")
    database = sqlite3.connect(tmp_path / "other.topo")
    database.executescript("CREATE TABLE nodes (a); INSERT INTO nodes VALUES (1);")
    database.close()
    with pytest.raises(MapError, match="an SQLite database but not a topoloc map"):
        TopoMetricMap.load(tmp_path / "other.topo")


@pytest.mark.parametrize(
    ("version", "who"),
    [(SCHEMA_VERSION + 1, "a newer topoloc"), (0, "an older topoloc; build it again")],
)
def test_other_schemas_are_named(saved: Path, version: int, who: str):
    with pytest.raises(MapVersionError, match=f"has schema {version}.*{who}"):
        TopoMetricMap.load(with_bytes(saved, 60, version.to_bytes(4, "big")))


@pytest.mark.parametrize("share", [0.00001, 0.01, 0.3, 0.7, 0.999999])
def test_a_truncated_map_is_refused_at_once(saved: Path, share: float):
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])
    with pytest.raises(MapError, match=r"is truncated|is not a topoloc map"):
        TopoMetricMap.load(saved)
