"""Localize each query once, and store the rows from which all tables and figures are made."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from topoloc.demo.recordings import SHIPPED
from topoloc.evaluation.metrics import EvaluatedQuery, summarize
from topoloc.evaluation.query_localization import localize_out_of_map, localize_queries
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.recordings.frame import StereoSequence, sequence_subset
from topoloc.recordings.open import open_sequence
from topoloc_paper.datasets import Dataset
from topoloc_paper.known_nodes import answer_with_known_nodes
from topoloc_paper.maps import MapKind, opened
from topoloc_paper.settings import Bench, evenly, sequence_digest
from topoloc_paper.stage_code import StageCode, asking
from topoloc_paper.stages import Done, digest_of
from topoloc_paper.stored_answers import answers_of, rows_of

WARM_UP = 3


@dataclass(frozen=True)
class Way:
    """Hold the settings of a query run: the map, the coarse localizer, the fine step. `knows_node`
    replaces the coarse localizer by ground truth."""

    kind: MapKind
    coarse: str = "surf-vlad"
    config: LocalizerConfig = field(default_factory=LocalizerConfig)
    knows_node: bool = False

    @property
    def name(self) -> str:
        special = asdict(self.config) != asdict(LocalizerConfig())
        coarse = "known-node" if self.knows_node else self.coarse
        return f"{self.kind.name}-{coarse}" + (
            f"-{digest_of(asdict(self.config))[:6]}" if special else ""
        )

    @property
    def code(self) -> StageCode:
        """Return the code on which the answers depend."""
        return asking(self.coarse, *(("topoloc_paper/known_nodes.py",) if self.knows_node else ()))


def asked(bench: Bench, dataset: Dataset, label: str, way: Way) -> Done:
    """Localize every query of one recording and return the rows (`stored_answers`).

    Raises:
        TopolocError: see `opened` and `localize_queries`.
    """
    topomap, digest = opened(bench, dataset, way.kind, way.coarse)
    sequence = queries_of(bench, dataset, label)

    def ask() -> list[dict[str, Any]]:
        config = replace(way.config, coarse=way.coarse)
        localizer = Localizer(topomap, config)
        for i in range(min(WARM_UP, len(sequence))):
            frame = sequence[i]
            if frame.camera is not None:
                localizer.localize(frame.image, frame.camera)
        told = f"{dataset.name} {label}: {way.name}"
        known = dataset.map_from_query_truth()

        def progress(_: str, done: int, total: int) -> None:
            bench.progress(told, done, total)

        if way.knows_node:
            found = answer_with_known_nodes(topomap, config, sequence, known, progress, label)
        else:
            found = localize_queries(localizer, sequence, known, progress, label)
        return rows_of(found)

    settings = {
        "map": digest,
        "config": asdict(way.config),
        "knows_node": way.knows_node,
        "queries": sequence_digest(sequence),
    }
    return bench.store.get(
        f"answers-{dataset.name}-{label.replace(' ', '_')}-{way.name}", settings, ask, way.code
    )


def answers(bench: Bench, dataset: Dataset, label: str, way: Way) -> list[EvaluatedQuery]:
    """The answers themselves, with their pictures at hand."""
    return answers_of(
        asked(bench, dataset, label, way).result, label, queries_of(bench, dataset, label)
    )


def summary(bench: Bench, dataset: Dataset, label: str, way: Way) -> dict[str, Any]:
    """Return the summary (`summarize`) of the answers."""
    return summarize(answers_of(asked(bench, dataset, label, way).result, label))


def queries_of(bench: Bench, dataset: Dataset, label: str) -> StereoSequence:
    sequence = dataset.open_queries(label)
    chosen = evenly(len(sequence), bench.config.max_queries)
    return sequence if len(chosen) == len(sequence) else sequence_subset(sequence, chosen)


def elsewhere_of(bench: Bench, dataset: Dataset) -> list[tuple[str, StereoSequence]]:
    """Images that were not taken in the data set's place: of the other places of its kind, and
    pictures of nothing."""
    paths = [(path, path) for path in dataset.elsewhere]
    for other in (*bench.rendered, *bench.real):
        if other.name != dataset.name and (other.is_real == dataset.is_real):
            paths += [(f"{other.name} {label}", path) for label, path in other.queries.items()]
    sequences = [
        (name, open_sequence(path))
        for name, path in [*paths, ("nothing", str(SHIPPED / "pictures_of_nothing"))]
    ]
    return [
        (name, sequence_subset(s, evenly(len(s), bench.config.max_elsewhere)))
        for name, s in sequences
    ]


def false_accepts(bench: Bench, dataset: Dataset, way: Way) -> dict[str, int]:
    """Of how many images from elsewhere a pose was given, and how many there were."""
    topomap, digest = opened(bench, dataset, way.kind, way.coarse)
    others = elsewhere_of(bench, dataset)

    def ask() -> dict[str, int]:
        localizer = Localizer(topomap, replace(way.config, coarse=way.coarse))
        given = [
            a
            for name, sequence in others
            for a in localize_out_of_map(localizer, sequence, label=name)
        ]
        return {"num_elsewhere": len(given), "accepted": sum(a.result.localized for a in given)}

    settings = {
        "map": digest,
        "config": asdict(way.config),
        "others": [sequence_digest(s) for _, s in others],
    }
    return bench.store.get(f"elsewhere-{dataset.name}-{way.name}", settings, ask, way.code).result
