"""Define the settings of a benchmark run, and the state that its stages share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from topoloc.recordings.frame import StereoSequence
from topoloc_paper.datasets import Dataset
from topoloc_paper.stages import StageStore, digest_of
from topoloc_paper.stored_answers import pose_to_json
from topoloc_training.classifier_config import BackboneName, TrainingConfig

Progress = Callable[[str, int, int], None]
LEARNED = ("cnn-fc", "cnn-nn", "vlad-nn")
BACKBONE_WORDS: dict[str, str] = {
    "squeezenet1_1": "SqueezeNet 1.1",
    "vgg11": "VGG-11",
    "vgg16": "VGG-16",
}


@dataclass(frozen=True)
class WeightFiles:
    """Hold the files of weights. Without the paper's networks SqueezeNet is used, with random
    weights if it has no file."""

    squeezenet: str | None = None
    vgg11: str | None = None
    vgg16: str | None = None

    def choice(self, method: str) -> tuple[BackboneName, str]:
        """Backbone, and file or `scratch`, of a coarse localizer or of `posenet`."""
        if method == "cnn-fc" and self.vgg11 is not None:
            return "vgg11", self.vgg11
        if method in ("cnn-nn", "vlad-nn") and self.vgg16 is not None:
            return "vgg16", self.vgg16
        return "squeezenet1_1", self.squeezenet or "scratch"

    def words(self, method: str) -> str:
        """Return a description of a method's weights for tables."""
        if method not in (*LEARNED, "posenet"):
            return "none needed"
        backbone, file = self.choice(method)
        if file == "scratch":
            return f"{BACKBONE_WORDS[backbone]}, from scratch" + (
                " (random features)" if method in ("cnn-nn", "vlad-nn") else ""
            )
        return f"{BACKBONE_WORDS[backbone]}, {Path(file).name}"

    def digest(self, method: str) -> list[str]:
        """Backbone and the file's SHA-256."""
        backbone, file = self.choice(method)
        return [backbone, file if file == "scratch" else _sha256(Path(file))]


@dataclass(frozen=True)
class PaperConfig:
    """Hold the settings of the benchmark.

    Attributes:
        draft: the recordings have the renderer's draft quality.
        quick: the small run on recordings that ship with topoloc.
        weights: see `WeightFiles`.
        epochs: the largest number of epochs of cnn-fc.
        posenet_epochs: the same of PoseNet, for each of its losses.
        max_shown: about the largest number of images in all epochs of a training. Places with many
            mapping images get fewer epochs.
        posenet_losses: the losses to train. The best on held-out images is used.
        max_colmap_images: the largest number of mapping images for pycolmap, evenly spread.
        max_elsewhere: the largest number of queries with images of each other place, for each map.
        max_queries: the largest number of queries of each recording, evenly spread; None for all.
    """

    draft: bool = False
    quick: bool = False
    weights: WeightFiles = field(default_factory=WeightFiles)
    epochs: int = 40
    posenet_epochs: int = 80
    max_shown: int = 20_000
    posenet_losses: tuple[str, ...] = ("learnt",)
    max_colmap_images: int = 250
    max_elsewhere: int = 20
    max_queries: int | None = None

    def with_epochs(self, epochs: int | None, posenet_epochs: int | None) -> PaperConfig:
        """Return these settings with other numbers of epochs. None keeps a number."""
        return replace(
            self, epochs=epochs or self.epochs, posenet_epochs=posenet_epochs or self.posenet_epochs
        )

    def training(self, epochs: int, num_images: int) -> TrainingConfig:
        """Return the training settings with at most `epochs` epochs, fewer for many images."""
        epochs = max(min(epochs, self.max_shown // max(num_images, 1)), 1)
        return TrainingConfig(max_epochs=epochs, patience=max(epochs // 3, 3))

    @staticmethod
    def for_quick_run(weights: WeightFiles) -> PaperConfig:
        """Small enough for five minutes."""
        return PaperConfig(
            quick=True,
            weights=weights,
            epochs=8,
            posenet_epochs=8,
            max_colmap_images=40,
            max_elsewhere=8,
        )


@dataclass(frozen=True, eq=False)
class Bench:
    """Hold a run: settings, places, folders of stages and maps, and the progress callback.

    `command` is the command line, for the tables. `missing` holds the names of missing recordings.
    """

    config: PaperConfig
    rendered: Sequence[Dataset]
    real: Sequence[Dataset]
    store: StageStore
    out: Path
    progress: Progress
    command: str
    missing: Sequence[str] = ()

    def folder(self, name: str) -> Path:
        """Return a folder of the run. It is made if it does not exist."""
        folder = self.out / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def sequence_digest(sequence: StereoSequence) -> str:
    """A short name for a recording: its frames' names and poses, and its first and last picture."""
    poses = [None if pose is None else pose_to_json(pose) for pose in sequence.poses]
    pictures = [
        hashlib.sha256(sequence[i].image.tobytes()).hexdigest() for i in (0, len(sequence) - 1)
    ]
    return digest_of([list(sequence.names), poses, pictures])


def evenly(num: int, most: int | None) -> list[int]:
    """At most `most` of the numbers below `num`, evenly spread."""
    if most is None or num <= most:
        return list(range(num))
    return [i * num // most for i in range(most)]


def _sha256(path: Path) -> str:
    from topoloc.errors import WeightsError

    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise WeightsError(f"cannot read weights {path}: {error.strerror}") from error
