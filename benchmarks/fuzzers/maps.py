"""Damaged map files, and damaged files that are kept to undo an edit."""

from __future__ import annotations

import json
import shutil
import sys
from functools import cache
from pathlib import Path

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.contradictions import find_contradictions
from topoloc.mapping.edit import edit_map, read_history, undo_edit
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.storage.kept_files import find_kept_files
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.image_io import read_image

from .damage import damage_bytes
from .harness import Read

TESTS = Path(__file__).parents[2] / "tests" / "mapping"
FIXTURES = Path(__file__).parents[2] / "tests" / "fixtures" / "aea690a"
sys.path[:0] = [str(TESTS), str(TESTS.parent)]
from mutations import mutate  # noqa: E402 # pyright: ignore[reportMissingImports]

EARLIER_MAPS = ("schema_1.topo", "schema_2.topo")
CURRENT_MAPS = ("schema_3.topo", "pruned.topo", "corridor.topo", "corridor.topo")


class Maps:
    """Maps of all schemas, and one with virtual nodes; damaged by bytes, or by SQL and arrays."""

    def make(self, folder: Path) -> None:
        """Write maps, and one image with its camera."""
        from built_corridor import WIDE, WalkAhead, seen_ahead
        from topoloc.localization.map_facts.map_building import build_map

        topomap = build_map(WalkAhead(0, num_pairs=6))
        assert topomap.sides is not None
        topomap.save(folder / "corridor.topo")
        for name in {*EARLIER_MAPS, *CURRENT_MAPS} - {"corridor.topo"}:
            shutil.copy(FIXTURES / name, folder)
        (image, _), *_ = seen_ahead()
        np.savez(folder / "corridor.npz", image=image, camera=json.dumps(WIDE.to_json()))
        camera = (FIXTURES / "queries" / "camera.json").read_text()
        np.savez(
            folder / "room.npz",
            image=read_image(FIXTURES / "queries" / "view0.jpg"),
            camera=json.dumps(json.loads(camera)),
        )

    def check(self, whole: Path) -> None:
        """Read all maps, and localize in them."""
        for path in whole.glob("*.topo"):
            read_map(path, *_query(whole, path.name))

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """Maps of earlier schemas are damaged by bytes alone."""
        is_sql = rng.random() < 0.7
        names = CURRENT_MAPS if is_sql else (*EARLIER_MAPS, *CURRENT_MAPS)
        name = names[rng.integers(len(names))]
        path = folder / name
        if is_sql:
            mutate(whole / name, path, int(rng.integers(2**62)))
        else:
            path.write_bytes(damage_bytes((whole / name).read_bytes(), rng))
        kind = "map, SQL and arrays" if is_sql else "map, bytes"
        return kind, lambda: read_map(path, *_query(whole, name))


@cache
def _query(whole: Path, name: str) -> tuple[np.ndarray, Camera]:
    with np.load(whole / ("corridor.npz" if name == "corridor.topo" else "room.npz")) as stored:
        return stored["image"], Camera.from_json(str(stored["camera"]))


def read_map(path: Path, image: np.ndarray, camera: Camera) -> None:
    """Localize an image in a map, then look at all its bytes. Raises TopolocError."""
    from topoloc.errors import MapError

    refusal = None
    try:
        with TopoMetricMap.load(path) as topomap:
            Localizer(topomap).localize(image, camera)
    except MapError as error:
        refusal = error
    found = find_map_damage(path)
    if not found:
        with TopoMetricMap.load(path) as topomap:
            found = [str(one) for one in find_contradictions(topomap)]
    if refusal is not None:
        raise refusal
    if found:
        raise MapError("; ".join(found))


class UndoFiles:
    """Kept files of a map, and now and then the map beside them: the map before the edit or after
    it is there, never a third one."""

    def make(self, folder: Path) -> None:
        """Write a map and the file before its last edit."""
        shutil.copy(FIXTURES / "schema_3.topo", folder / "map.topo")
        with edit_map(folder / "map.topo") as edit:
            edit.commit(edit.topomap, "first")
        with edit_map(folder / "map.topo") as edit:
            edit.commit(edit.topomap, "second")

    def check(self, whole: Path) -> None:
        """Both edits can be undone."""
        assert [row["undoable"] for row in read_history(whole / "map.topo")][-2:] == [True, True]

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """One kept file is damaged, or has the name of another one."""
        for one in whole.iterdir():
            shutil.copyfile(one, folder / one.name)
        path = folder / "map.topo"
        kept = find_kept_files(path)
        victim = kept[0] if rng.random() < 0.8 else kept[1]
        before, after = kept[0].read_bytes(), path.read_bytes()
        if rng.random() < 0.5:
            mutate(whole / victim.name, victim, int(rng.integers(2**62)))
        elif rng.random() < 0.9:
            victim.write_bytes(damage_bytes(victim.read_bytes(), rng))
        else:
            victim.rename(victim.with_name(victim.name[:-4] + "0000"))
        is_edited = rng.random() < 0.2
        kind = "kept file, next edit" if is_edited else "kept file, undo"
        read = _edit_and_undo if is_edited else _undo
        return kind, lambda: read(path, before, after)


def _undo(path: Path, before: bytes, after: bytes) -> None:
    read_history(path)
    try:
        undo_edit(path)
    finally:
        assert path.read_bytes() in (before, after), "another map"
    assert path.read_bytes() == before, "nothing was undone"


def _edit_and_undo(path: Path, _: bytes, after: bytes) -> None:
    with edit_map(path) as edit:
        edit.commit(edit.topomap, "third")
    undo_edit(path)
    assert path.read_bytes() == after, "another map"
    assert not list(path.parent.glob(".*.part"))
