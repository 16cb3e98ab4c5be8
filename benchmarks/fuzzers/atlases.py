"""Damaged manifests of atlases, and damaged files of global descriptors."""

from __future__ import annotations

import hashlib
import json
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.apps.georeferencing.georeference import georeference
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Manifest
from topoloc.atlas.place import SharedWorld
from topoloc.errors import TopolocError
from topoloc.geometry.camera import Camera
from topoloc.geometry.geodesy import GeoPoint
from topoloc.localization.localizer import Localizer
from topoloc.recordings.image_io import read_image

from .damage import damage_bytes, damage_json
from .harness import Read
from .maps import FIXTURES

JOIN = {
    "first": "room0",
    "second": "room1",
    "first_from_second": [[1.0, 0, 0, 0.5], [0, 1.0, 0, 0], [0, 0, 1.0, 0.25]],
    "covariance": (1e-4 * np.eye(6)).tolist(),
    "num_agreeing": 7,
    "residual": 0.5,
}
"""A relative pose of the two tiles, so that a manifest has all its keys."""


class Manifests:
    """`atlas.json`, damaged by bytes or by values, its digest right again or not."""

    def make(self, folder: Path) -> None:
        """Write an atlas of two tiles with a join and a place on earth."""
        _make_atlas(folder)

    def check(self, whole: Path) -> None:
        """Read the atlas, and localize in it."""
        read_atlas(whole / "atlas", is_queried=True)

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """The files of the tiles are undamaged."""
        where, text = folder / "atlas", (whole / "atlas" / "atlas.json").read_text()
        (where / "tiles").mkdir(parents=True)
        for one in (whole / "atlas" / "tiles").iterdir():
            (where / "tiles" / one.name).symlink_to(one)
        if rng.random() < 0.3:
            (where / "atlas.json").write_bytes(damage_bytes(text.encode(), rng))
            return "manifest, bytes", lambda: read_atlas(where, is_queried=False)
        is_sealed, is_queried = rng.random() < 0.8, rng.random() < 0.1
        damaged = damage_json(text, rng, _sealed if is_sealed else lambda data: data)
        (where / "atlas.json").write_text(damaged)
        return "manifest, values", lambda: read_atlas(where, is_queried)


class PlaceVectors:
    """`.places` files, with their checksum in the manifest or not."""

    def make(self, folder: Path) -> None:
        """Write an atlas of two tiles."""
        _make_atlas(folder)

    def check(self, whole: Path) -> None:
        """All tiles can be ranked."""
        assert not Atlas.open(str(whole / "atlas")).index.problems

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """Damage the bytes, or the arrays."""
        where = folder / "atlas"
        shutil.copytree(whole / "atlas", where)
        data = json.loads((where / "atlas.json").read_text())
        stored = data["tiles"][rng.integers(2)]["places"]
        path, is_sealed = where / stored["file"], rng.random() < 0.7
        if is_arrays := rng.random() < 0.5:
            _damage_arrays(path, rng)
        else:
            path.write_bytes(damage_bytes(path.read_bytes(), rng))
        if is_sealed:
            stored["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
            stored["bytes"] = path.stat().st_size
            (where / "atlas.json").write_text(json.dumps(_sealed(data)))
        is_queried = rng.random() < 0.1
        kind = f"places, {'arrays' if is_arrays else 'bytes'}"
        return kind, lambda: _read_places(where, is_queried)


def _make_atlas(folder: Path) -> None:
    shutil.copytree(FIXTURES / "atlas", folder / "maps")
    where, maps = folder / "atlas", folder / "maps" / "tiles"
    first, second = folder / "room0.topo", folder / "room1.topo"
    shutil.copy(next(maps.glob("room0*.topo")), first)
    shutil.copy(next(maps.glob("room1*.topo")), second)
    georeference(first, (GeoPoint(50.87, 4.7, 30.0), 12.0))
    Atlas.create(str(where), [str(first), str(second)])
    data = json.loads((where / "atlas.json").read_text())
    data["joins"] = [JOIN]
    (where / "atlas.json").write_text(json.dumps(_sealed(data)))


def _sealed(data: Any) -> Any:
    """Return the manifest with the digest of its content."""
    if not isinstance(data, dict):
        return data
    content = {key: value for key, value in data.items() if key != "digest"}
    return content | {
        "digest": hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    }


@cache
def _query() -> tuple[np.ndarray, Camera]:
    camera = Camera.from_json((FIXTURES / "queries" / "camera.json").read_text())
    return read_image(FIXTURES / "queries" / "view0.jpg"), camera


def read_atlas(where: Path, is_queried: bool) -> None:
    """Use all that an atlas holds. Raises TopolocError, also for a damaged tile."""
    atlas = Atlas.open(str(where))
    manifest: Manifest = atlas.manifest
    SharedWorld.group(manifest)
    _ = manifest.geo_boxes, manifest.world_boxes, atlas.kinds, atlas.index
    for tile in manifest.tiles:
        manifest.georeference_of(tile)
        tile.to_json()
    Manifest.from_bytes(manifest.to_bytes(), "again")
    problems = list(atlas.index.problems.values())
    for name in atlas.select_tiles():
        try:
            problems += [atlas.find_problem(name) or ""]
            atlas.history(name)
        except TopolocError as error:
            problems.append(str(error))
    if is_queried:
        Localizer(atlas, warn=problems.append).localize(*_query())
    if any(problems):
        raise TopolocError("; ".join(problems))


def _read_places(where: Path, is_queried: bool) -> None:
    atlas = Atlas.open(str(where))
    problems = [*atlas.index.problems.values(), *atlas.index.notes]
    if is_queried:
        Localizer(atlas, warn=problems.append).localize(*_query())
    if problems:
        raise TopolocError("; ".join(problems))


def _damage_arrays(path: Path, rng: np.random.Generator) -> None:
    with np.load(path) as stored:
        arrays: dict[str, Any] = dict(stored)
    name = list(arrays)[rng.integers(len(arrays))]
    rows = arrays.pop(name)
    way = rng.integers(10)
    changed = [
        rows[:-1],
        np.concatenate([rows] * 3000),
        rows.astype(np.float32),
        rows.astype("U8"),
        np.full_like(rows, np.nan),
        rows[:, :-1],
        rows.ravel(),
        np.zeros_like(rows),
        rows * np.float16(1e4),
        rows.astype(np.int8),
    ][way]
    arrays[name if rng.random() < 0.8 else "x" * 300] = changed
    (np.savez_compressed if rng.random() < 0.3 else np.savez)(path.open("wb"), **arrays)
