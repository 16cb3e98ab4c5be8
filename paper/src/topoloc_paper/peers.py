"""Others on the same work: the paper's fine step as written, hloc's scheme in pycolmap, retrieval
alone, and topoloc, in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from topoloc.errors import MissingExtraError
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame
from topoloc_paper.asking import Way, elsewhere_of, false_accepts, queries_of, summary
from topoloc_paper.datasets import Dataset
from topoloc_paper.installed_size import installed_bytes
from topoloc_paper.maps import MapKind, built, path_of
from topoloc_paper.peer_answers import Peer, rows_of, summarize_peer
from topoloc_paper.peer_colmap import Colmap
from topoloc_paper.peer_paper_step import PaperStep
from topoloc_paper.peer_retrieval import Retrieval
from topoloc_paper.settings import Bench, sequence_digest
from topoloc_paper.stage_code import answering

# What each needs to be installed, to answer a query.
NEEDS = {
    "topoloc": ("topoloc",),
    "the paper's step": ("opencv-python-headless",),
    "pycolmap, SIFT": ("pycolmap",),
    "retrieval only": ("topoloc",),
}


def rows(bench: Bench, datasets: list[Dataset]) -> list[dict[str, Any]]:
    """Rows for every recording; each peer has the map by the paper's D_thresh, topoloc and pycolmap
    also topoloc's own nodes."""
    return [row for dataset in datasets for row in _rows(bench, dataset)]


def _rows(bench: Bench, dataset: Dataset) -> list[dict[str, Any]]:
    paper, own = MapKind.as_paper(dataset), MapKind.as_topoloc()
    found = [row for kind in (paper, own) for row in _our_rows(bench, dataset, kind)]
    for name, kind in (
        ("the paper's step", paper),
        ("pycolmap, SIFT", own),
        ("retrieval only", paper),
        ("retrieval only", own),
    ):
        found += _peer_rows(bench, dataset, name, kind)
    order = {label: number for number, label in enumerate(dataset.queries)}
    return sorted(found, key=lambda row: order[row["queries"]])


def _our_rows(bench: Bench, dataset: Dataset, kind: MapKind) -> list[dict[str, Any]]:
    way = Way(kind)
    elsewhere, facts = false_accepts(bench, dataset, way), built(bench, dataset, kind).result
    found = []
    for label in dataset.queries:
        result = summary(bench, dataset, label, way)
        row = (
            _head(dataset, label, "topoloc", kind)
            | elsewhere
            | {
                "map_bytes": facts["bytes"],
                "far_off": result["false_accepts"],
            }
        )
        row |= {
            key: result[key]
            for key in (
                "num_queries",
                "num_localized",
                "median_translation_m",
                "median_rotation_deg",
            )
        }
        found.append(
            row
            | {
                "recall_25cm": result["recall"]["0.25m_2deg"],
                "ms": result["median_times_ms"]["total"],
            }
        )
    return found


def _peer_rows(bench: Bench, dataset: Dataset, name: str, kind: MapKind) -> list[dict[str, Any]]:
    """Return the rows of one peer. All recordings and out-of-map images are localized in one map,
    in one stage."""
    map_done = built(bench, dataset, kind)
    queries = {label: queries_of(bench, dataset, label) for label in dataset.queries}
    others = elsewhere_of(bench, dataset)

    def ask() -> dict[str, Any]:
        bench.progress(f"{name} in {dataset.name}", 0, 1)
        peer = _MAKERS[name](bench, dataset, kind)
        known = dataset.map_from_query_truth()
        frames = {
            label: [f for f in sequence if f.world_from_cam is not None]
            for label, sequence in queries.items()
        }
        strangers = [_stranger(frame) for _, sequence in others for frame in sequence]
        everything = [frame for group in frames.values() for frame in group] + strangers
        answers = iter(peer.localize(everything))
        asked = {
            label: rows_of(group, [next(answers) for _ in group], known)
            for label, group in frames.items()
        }
        asked_elsewhere = rows_of(strangers, list(answers), known)
        bench.progress(f"{name} in {dataset.name}", 1, 1)
        return {"queries": asked, "elsewhere": asked_elsewhere, "map_bytes": peer.map_bytes}

    digests = [sequence_digest(s) for s in queries.values()] + [
        sequence_digest(s) for _, s in others
    ]
    settings = {
        "map": map_done.digest,
        "queries": digests,
        "max_images": bench.config.max_colmap_images,
    }
    heads = [_head(dataset, label, name, kind) for label in dataset.queries]
    try:
        stage = f"peer-{dataset.name}-{kind.name}-{name.replace(' ', '_').replace(',', '').replace(chr(39), '')}"  # noqa: E501
        result = bench.store.get(stage, settings, ask, answering(*_CODE[name])).result
    except MissingExtraError as error:
        return [head | {"missing": str(error)} for head in heads]
    elsewhere = result["elsewhere"]
    return [
        head
        | summarize_peer(result["queries"][head["queries"]] + elsewhere)
        | {"map_bytes": result["map_bytes"]}
        for head in heads
    ]


def _head(dataset: Dataset, label: str, name: str, kind: MapKind) -> dict[str, Any]:
    head = {
        "dataset": dataset.name,
        "queries": label,
        "peer": name,
        "nodes": kind.words,
        "real": dataset.is_real,
    }
    return head | {"installed_bytes": installed_bytes(NEEDS[name])}


def _stranger(frame: StereoFrame) -> StereoFrame:
    """The frame without its pose, which is one of another world."""
    return StereoFrame(frame.name, frame.t_ns, frame.image, frame.camera)


def _opened(bench: Bench, dataset: Dataset, kind: MapKind) -> TopoMetricMap:
    return TopoMetricMap.load(path_of(bench, dataset, kind))


def _colmap(bench: Bench, dataset: Dataset, kind: MapKind) -> Peer:
    return Colmap(
        _opened(bench, dataset, kind),
        dataset.open_mapping(),
        bench.config.max_colmap_images,
        bench.out,
    )


_MAKERS: dict[str, Callable[[Bench, Dataset, MapKind], Peer]] = {
    "the paper's step": lambda bench, dataset, kind: PaperStep(
        _opened(bench, dataset, kind), dataset.open_mapping()
    ),
    "pycolmap, SIFT": _colmap,
    "retrieval only": lambda bench, dataset, kind: Retrieval(_opened(bench, dataset, kind)),
}
_CODE: dict[str, Sequence[str]] = {
    "the paper's step": ("topoloc_paper/peer_paper_step.py",),
    "pycolmap, SIFT": ("topoloc_paper/peer_colmap.py", "topoloc_paper/colmap_worker.py"),
    "retrieval only": ("topoloc_paper/peer_retrieval.py",),
}
