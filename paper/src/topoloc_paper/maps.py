"""The maps of the benchmark: built once, given the learned coarse localizers once, and opened from
their files."""

from __future__ import annotations

import hashlib
import io
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from topoloc.errors import MissingExtraError
from topoloc.features.extraction import FeatureConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.atomic import write_bytes
from topoloc.retrieval.coarse import CoarseModel
from topoloc_paper.datasets import Dataset
from topoloc_paper.settings import LEARNED, Bench, sequence_digest
from topoloc_paper.stage_code import COARSE_MODULES, MAPPING, learning
from topoloc_paper.stages import Done, digest_of
from topoloc_paper.stored_answers import pose_to_json
from topoloc_training.classifier_config import CnnFcConfig, NetworkInputConfig
from topoloc_training.coarse_training import CoarseTrainingConfig, train_coarse

Normalization = Literal["none", "paper", "wide"]


@dataclass(frozen=True)
class MapKind:
    """How a data set is mapped. `d_thresh` and `lambda_rot` None: topoloc's own defaults, by the
    scene's depth."""

    d_thresh: float | None
    lambda_rot: float | None
    normalization: Normalization = "wide"
    kind: Literal["surf", "sift"] = "surf"

    @staticmethod
    def as_paper(dataset: Dataset, normalization: Normalization = "wide") -> MapKind:
        """The paper's D_thresh and lambda."""
        return MapKind(dataset.d_thresh, dataset.lambda_rot, normalization)

    @staticmethod
    def as_topoloc(normalization: Normalization = "wide") -> MapKind:
        """Return the default settings of `topoloc build`."""
        return MapKind(None, None, normalization)

    @property
    def name(self) -> str:
        nodes = "default" if self.d_thresh is None else f"d{self.d_thresh:g}"
        return f"{nodes}-{self.kind}-{self.normalization}"

    @property
    def words(self) -> str:
        """For tables: how the nodes are placed."""
        return "default nodes" if self.d_thresh is None else f"D_thresh {self.d_thresh:g} m"

    def config(self) -> BuildConfig:
        """Return the build settings.

        Every map also has the default learned feature type, if its network is available.
        """
        features = FeatureConfig(kind=self.kind, normalization=self.normalization)
        learned = tuple(BuildConfig().kinds[1:])
        nodes = NodeConfig(self.d_thresh, self.lambda_rot)
        return BuildConfig(nodes=nodes, features=features, other_kinds=learned)


def built(bench: Bench, dataset: Dataset, kind: MapKind) -> Done:
    """The facts of the data set's map of this kind, which lies at `path_of` afterwards.

    Raises:
        EmptyMapError, TrajectoryError, RecordingError: see `build_map`.
    """
    name = f"{dataset.name}-{kind.name}"
    path = path_of(bench, dataset, kind)
    sequences = dataset.open_mapping()

    def build() -> dict[str, Any]:
        topomap = build_map(
            sequences,
            kind.config(),
            lambda stage, done, total: bench.progress(f"map {name}: {stage}", done, total),
        )
        topomap.save(path)
        facts = {
            "num_nodes": len(topomap.summaries),
            "num_images": len(topomap.place_images),
            "length_m": topomap.length_m,
        }
        place_bytes = sum(len(image.jpeg) for image in topomap.place_images)
        nodes = asdict(topomap.config.nodes)
        facts["images_digest"] = images_digest(topomap)
        return facts | {"bytes": path.stat().st_size, "place_bytes": place_bytes, "nodes": nodes}

    settings = {
        "config": asdict(kind.config()),
        "recordings": [sequence_digest(sequence) for sequence in sequences],
    }
    return bench.store.get(f"map-{name}", settings, build, MAPPING, [path])


def taught(bench: Bench, dataset: Dataset, kind: MapKind, method: str) -> Done:
    """Train a learned coarse localizer, and return its facts: training data and duration.

    `opened` returns the map that contains it. The localizer depends on the mapping images and their
    nodes alone, so it is kept if only the map's points have changed.

    Raises:
        MissingExtraError: torch is not installed.
        WeightsError, TrainingError: see `train_coarse`.
    """
    map_done = built(bench, dataset, kind)
    target = _model_path(bench, dataset, kind, method)
    backbone, weights = bench.config.weights.choice(method)
    config = _training_config(bench, map_done.result["num_images"])
    settings = {
        "images": map_done.result["images_digest"],
        "weights": bench.config.weights.digest(method),
        "config": asdict(config),
    }

    def train() -> dict[str, Any]:
        checkpoint = (
            target.with_suffix(f".{digest_of(settings)}.checkpoint") if method == "cnn-fc" else None
        )
        topomap, label = (
            TopoMetricMap.load(path_of(bench, dataset, kind)),
            f"{method} of {dataset.name}",
        )
        model = train_coarse(
            topomap,
            method,
            backbone,
            weights,
            config,
            lambda stage, done, total: bench.progress(label, done, total),
            checkpoint,
        )
        buffer = io.BytesIO()
        arrays: dict[str, Any] = dict(model.arrays)
        np.savez(buffer, **arrays)
        write_bytes(target, buffer.getvalue())
        if checkpoint is not None:
            checkpoint.unlink(missing_ok=True)
        return {"settings": dict(model.settings), "bytes": target.stat().st_size}

    return bench.store.get(
        f"coarse-{dataset.name}-{kind.name}-{method}",
        settings,
        train,
        learning(COARSE_MODULES[method]),
        [target],
    )


def opened(
    bench: Bench, dataset: Dataset, kind: MapKind, method: str = "surf-vlad"
) -> tuple[TopoMetricMap, str]:
    """Return the map with this default coarse localizer, and the digest of both (`Done.digest`).

    Raises:
        TopolocError: see `taught`.
    """
    map_done = built(bench, dataset, kind)
    topomap = TopoMetricMap.load(path_of(bench, dataset, kind))
    if method not in LEARNED:
        return topomap, map_done.digest
    done = taught(bench, dataset, kind, method)
    with np.load(_model_path(bench, dataset, kind, method)) as arrays:
        model = CoarseModel(method, done.result["settings"], dict(arrays))
    topomap = topomap.with_first_layer(coarse_models={method: model})
    return replace(topomap, default_coarse=method), digest_of([map_done.digest, done.digest])


def path_of(bench: Bench, dataset: Dataset, kind: MapKind) -> Path:
    """The map's file."""
    return bench.folder("maps") / f"{dataset.name}-{kind.name}.topo"


def _model_path(bench: Bench, dataset: Dataset, kind: MapKind, method: str) -> Path:
    return bench.folder("models") / f"{dataset.name}-{kind.name}-{method}.npz"


def images_digest(topomap: TopoMetricMap) -> str:
    """Return a digest of a classifier's training data: the mapping images, their poses and their
    nodes."""
    rows = [
        [hashlib.sha256(i.jpeg).hexdigest(), i.node_id, pose_to_json(i.world_from_cam)]
        for i in topomap.place_images
    ]
    return digest_of(
        [rows, [pose_to_json(summary.world_from_cam) for summary in topomap.summaries]]
    )


def why_not(bench: Bench, method: str) -> str | None:
    """Return the missing requirement of a method, None if there is none."""
    if method not in (*LEARNED, "posenet"):
        return None
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        return str(MissingExtraError("PyTorch is not installed: pip install . ./training"))
    return None


def _training_config(bench: Bench, num_images: int) -> CoarseTrainingConfig:
    # a quarter of the work of the default; tables show what it costs
    picture = NetworkInputConfig(112, 84)
    training = bench.config.training(bench.config.epochs, num_images)
    return replace(CoarseTrainingConfig(), cnn_fc=CnnFcConfig(picture=picture, training=training))
