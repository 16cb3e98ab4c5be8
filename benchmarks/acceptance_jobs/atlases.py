"""Atlases, places on earth, and exports that other programs read."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .answers import compare_answers
from .figures import Figure
from .workplace import SkippedError, Workplace, need_module

ORIGIN = ("--origin", "50.8,4.7,30,0")


def atlas(work: Workplace) -> Iterator[Figure]:
    """Create, join and query an atlas. Remove one tile and restore it. Georeference the answers."""
    first, second, where = (work.folder / name for name in ("first.topo", "second.topo", "atlas"))
    work.topoloc("build", work.data("zed_lab/session1@0:52"), first)
    work.topoloc("build", work.data("zed_lab/session1@40:88"), second)
    tiles = [first, second, work.map("kitchen")]
    work.topoloc("atlas", "create", where, *tiles)
    joined = work.answer("atlas", "join", where)
    together = max(len(world) for world in joined["worlds"].values())
    yield Figure("tiles of one world after join", together, "at least")
    asked = (where, *_images(work), "--camera", "unknown")
    before = work.answer("localize", *asked)
    zed, kitchen = (sum(line.get("tile") in names and line["localized"] for line in before)
                    for names in (("first", "second"), ("kitchen",)))  # fmt: skip
    yield Figure("ZED images in a right tile of 20", zed, "at least")
    yield Figure("kitchen images in the right tile of 20", kitchen, "at least")
    wrong = sum(line["localized"] for line in before[40:])
    yield Figure(f"out-of-map images accepted of {len(before) - 40}", wrong, "at most")
    work.topoloc("atlas", "remove", where, "kitchen")
    work.topoloc("atlas", "add", where, tiles[2])
    after = compare_answers(before, work.answer("localize", *asked))
    yield Figure("other answers, one tile away and back", after.different, "at most")
    work.topoloc("georeference", where, "--tile", "first", *ORIGIN)
    known = work.answer("localize", *asked)
    yield Figure("answers with a geopose", sum("geopose" in line for line in known), "at least")
    work.topoloc("atlas", "info", where, "--check")
    yield Figure("atlas info --check", 1, "at least")


def export(work: Workplace) -> Iterator[Figure]:
    """Export a map and results to every format, and read them with other programs."""
    path = work.own_map("zed")
    work.topoloc("georeference", path, *ORIGIN)
    for out in ("nodes.tum", "all.kitti", "points.ply", "map.geojson"):
        work.topoloc("export", path, work.folder / out)
    work.topoloc("export", path, work.folder / "nerf", "--format", "nerfstudio")
    work.topoloc("export", path, work.folder / "model")
    results = work.folder / "results.jsonl"
    queries = work.data("zed_lab/session2@0:99:9")
    work.topoloc("localize", path, queries, "--single", "--json", results)
    work.topoloc("export", results, work.folder / "results.tum")
    nodes = _tum_positions(work.folder / "nodes.tum")
    yield Figure("tum: poses of nodes", len(nodes), "at least")
    yield Figure("tum: poses of results", len(_tum_positions(work.folder / "results.tum")))
    found = json.loads((work.folder / "nerf" / "transforms.json").read_text())["frames"]
    nerf = [[row[3] for row in frame["transform_matrix"][:3]] for frame in found]
    yield Figure("nerfstudio: positions that are those of tum", _same(nodes, nerf), "at least")
    lines = (work.folder / "all.kitti").read_text().splitlines()
    yield Figure("kitti: rows of 12 numbers", sum(len(line.split()) == 12 for line in lines))
    yield Figure("ply: has a header", int(_begins(work.folder / "points.ply", b"ply\n")))
    features = json.loads((work.folder / "map.geojson").read_text())["features"]
    yield Figure("geojson: features", len(features))
    yield from _colmap(work.folder / "model", nodes)
    yield from _mcap(work, path)


def _colmap(model: Path, nodes: list[list[float]]) -> Iterator[Figure]:
    name = "colmap: positions that are those of tum (pycolmap)"
    try:
        need_module("pycolmap")
    except SkippedError as missing:
        yield Figure(name, None, skipped=str(missing))
        return
    import pycolmap  # pyright: ignore[reportMissingImports]

    reconstruction = pycolmap.Reconstruction(str(model))
    centres = [list(image.projection_center()) for image in reconstruction.images.values()]
    yield Figure(name, _same(nodes, centres), "at least")


def _mcap(work: Workplace, path: Path) -> Iterator[Figure]:
    names = ("mcap: poses (mcap's reader)", "mcap: images (mcap's reader)")
    try:
        need_module("mcap")
    except SkippedError as missing:
        yield from (Figure(name, None, skipped=str(missing)) for name in names)
        return
    from mcap.reader import make_reader  # pyright: ignore[reportMissingImports]

    work.topoloc("export", path, work.folder / "map.mcap")
    counts: dict[str, int] = {}
    with (work.folder / "map.mcap").open("rb") as file:
        for schema, _, _ in make_reader(file).iter_messages():
            kind = schema.name.rpartition(".")[2] if schema else ""
            counts[kind] = counts.get(kind, 0) + 1
    yield Figure(names[0], counts.get("PoseInFrame", 0), "at least")
    yield Figure(names[1], counts.get("CompressedImage", 0), "at least")


def _images(work: Workplace) -> list[Path]:
    """Return 20 images of the ZED lab, 20 of the kitchen and 10 of other places."""
    zed = sorted((Path(work.data("zed_lab/session2")) / "image_0").iterdir())[:99]
    kitchen = sorted(Path(work.data("seven_scenes/kitchen")).rglob("*.color.jpg"))[1::2]
    tower = sorted(Path(work.data("ie_tower")).rglob("*.jpg"))
    # Names must differ, so that the copies can be told apart.
    chosen = [*zed[::5][:20], *kitchen[::8][:20], *tower[::75][:10]]
    folder = work.folder / "images"
    folder.mkdir()
    copies = [folder / f"{k:02d}{path.suffix}" for k, path in enumerate(chosen)]
    return [Path(shutil.copy(path, copy)) for path, copy in zip(chosen, copies, strict=True)]


def _tum_positions(path: Path) -> list[list[float]]:
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    return [[float(word) for word in row[1:4]] for row in rows]


def _same(nodes: list[list[float]], others: list[Any]) -> int:
    """Return how many nodes have a position of the others within 0.01 mm."""
    return sum(any(math.dist(node, other) < 1e-5 for other in others) for node in nodes)


def _begins(path: Path, text: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(text)) == text
