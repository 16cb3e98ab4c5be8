"""PoseNet, the baseline of the paper: a network that regresses the camera's pose from one picture.

Kendall, Grimes & Cipolla (2015) with the beta-weighted loss; Kendall & Cipolla (2017) with the
weights of translation and rotation learnt, and with the error of reprojection. Trained on the
mapping images that our own classifiers are trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from topoloc.bounds import parse_settings
from topoloc.errors import WeightsError
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import Image
from topoloc_paper.pose_losses import beta_loss, learnt_loss, reprojection_loss
from topoloc_training.augmentation import augment
from topoloc_training.backbones import Backbone, normalize_images
from topoloc_training.classifier_config import (
    AugmentationConfig,
    BackboneName,
    NetworkInputConfig,
    TrainingConfig,
)
from topoloc_training.coarse_training import training_set_of
from topoloc_training.inference import BATCH_SIZE, to_channels_last
from topoloc_training.network_images import ImageShape, prepare_network_images
from topoloc_training.training import Task, Training, fit, hold_out
from topoloc_training.training_set import Progress, decode_pictures
from topoloc_training.weights import Weights, load_features

_ROWS, _COLUMNS, _SQUEEZED = 4, 5, 64
POINTS_PER_IMAGE = 64
# Metres a radian, the paper's lambda: how rotation counts where one PoseNet is preferred to
# another.
LAMBDA_ROT = 2.0


@dataclass(frozen=True)
class PoseNetConfig:
    """Settings of PoseNet. The pictures are not moved while training, since that would change the
    pose."""

    loss: Literal["beta", "learnt", "reprojection"] = "learnt"
    """`reprojection` begins with `learnt`, as its authors advise."""
    beta: float = 2.0
    """Metres that an error of the quaternion by 1 counts, with `beta`."""
    num_hidden: int = 512
    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    augmentation: AugmentationConfig = field(
        default_factory=lambda: AugmentationConfig(crop=0.0, rotation_deg=0.0)
    )


class PoseRegressor(nn.Module):
    """Images to translations (n, 3), metres, and unit quaternions (n, 4), w first."""

    def __init__(self, backbone: BackboneName, num_hidden: int) -> None:
        super().__init__()
        self.backbone = Backbone(backbone, num_outputs=None)
        squeeze = [
            nn.Conv2d(self.backbone.num_channels, _SQUEEZED, 1),
            nn.ReLU(True),
            nn.AdaptiveAvgPool2d((_ROWS, _COLUMNS)),
        ]
        self.hidden = nn.Sequential(
            *squeeze,
            nn.Flatten(),
            nn.Linear(_SQUEEZED * _ROWS * _COLUMNS, num_hidden),
            nn.ReLU(True),
            nn.Dropout(0.2),
        )
        self.translation, self.quaternion = nn.Linear(num_hidden, 3), nn.Linear(num_hidden, 4)
        self.log_variances = nn.Parameter(
            torch.tensor([0.0, -3.0])
        )  # of the learnt loss, begun as its authors do
        self.centre, self.scale = nn.Buffer(torch.zeros(3)), nn.Buffer(torch.ones(3))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.hidden(self.backbone(images)).float()
        translation = self.translation(hidden) * self.scale + self.centre
        return translation, nn.functional.normalize(
            self.quaternion(hidden) + torch.tensor([0.1, 0.0, 0.0, 0.0]), dim=1
        )


@dataclass(eq=False)
class PoseNet:
    """A trained PoseNet. `held_out_m` is its mean D_total (metres, Eq. 1 with the paper's lambda)
    on the held-out images."""

    backbone: BackboneName
    config: PoseNetConfig
    picture_shape: ImageShape
    network: PoseRegressor
    held_out_m: float
    training: Training | None = None

    def localize(self, images: Sequence[Image]) -> list[Rigid3]:
        """Return world_from_cam of each image. PoseNet never refuses an image."""
        pictures = torch.from_numpy(
            prepare_network_images(images, self.picture_shape, self.config.picture)
        )
        translations, quaternions = _poses(self.network, pictures)
        return [
            Rigid3.from_quat_wxyz(quat_wxyz, translation)
            for translation, quat_wxyz in zip(
                translations.double().numpy(), quaternions.double().numpy(), strict=True
            )
        ]

    def save(self, path: Path) -> None:
        """Write the network and its settings to one file."""
        shape = [self.picture_shape.width, self.picture_shape.height]
        facts = {
            "backbone": self.backbone,
            "config": asdict(self.config),
            "picture_shape": shape,
            "held_out_m": self.held_out_m,
        }
        torch.save(facts | {"network": self.network.state_dict()}, path)

    @staticmethod
    def load(path: Path) -> PoseNet:
        """The inverse of `save`. Raises WeightsError."""
        try:
            content = torch.load(path, weights_only=True)
            config = parse_settings(PoseNetConfig, content["config"], "config", is_strict=False)
            network = PoseRegressor(content["backbone"], config.num_hidden)
            network.load_state_dict(content["network"])
            shape = ImageShape(*content["picture_shape"])
            return PoseNet(
                content["backbone"], config, shape, network.eval(), content["held_out_m"]
            )
        except Exception as error:  # whatever PyTorch makes of bytes that are no such file
            raise WeightsError(
                f"{path} is no PoseNet, or damaged: {' '.join(str(error).split())[:200]}"
            ) from error


def train_posenet(
    topomap: TopoMetricMap,
    backbone: BackboneName,
    weights: Weights | None,
    config: PoseNetConfig,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> PoseNet:
    """Train on the map's images but those held out.

    Args:
        checkpoint: the state is written after each epoch beside this file, under its name and the
            loss's, and gone on from if it is there.

    Raises:
        TrainingError: the loss was not finite, or a checkpoint is of another training.
        EmptyMapError, MapError: the map holds no images, or is damaged.
    """
    progress = progress or (lambda stage, done, total: None)
    training_set = training_set_of(topomap)
    images, shape = decode_pictures(training_set)
    pictures = torch.from_numpy(prepare_network_images(images, shape, config.picture))
    translations = torch.tensor(
        np.stack([p.translation for p in training_set.world_from_cams]), dtype=torch.float32
    )
    quaternions = torch.tensor(
        np.stack([p.quat_wxyz() for p in training_set.world_from_cams]), dtype=torch.float32
    )
    held_out = hold_out(training_set.node_ids, config.training.held_out, config.training.seed)
    judged = np.flatnonzero(held_out) if held_out.any() else np.arange(len(held_out))
    torch.manual_seed(config.training.seed)
    network = PoseRegressor(backbone, config.num_hidden)
    to_channels_last(network)
    network.centre.copy_(translations.mean(dim=0))
    network.scale.copy_(translations.std(dim=0, correction=0).clamp(min=0.05))
    pretrained = [] if weights is None else list(network.backbone.parameters())
    if weights is not None:
        load_features(network.backbone, weights)
    points = (
        torch.tensor(_seen_points(topomap, training_set.node_ids))
        if config.loss == "reprojection"
        else torch.zeros(0)
    )

    def loss_of(kind: str, rows: Tensor, generator: Generator) -> Tensor:
        found = network(augment(pictures[rows], config.augmentation, generator))
        truth = (translations[rows], quaternions[rows])
        if kind == "beta":
            return beta_loss(found, truth, config.beta)
        if kind == "learnt":
            return learnt_loss(found, truth, network.log_variances)
        return reprojection_loss(found, truth, points[rows])

    def score() -> float:
        found_t, found_q = _poses(network, pictures[judged])
        angles = 2.0 * torch.arccos((found_q * quaternions[judged]).sum(dim=1).abs().clamp(max=1.0))
        return float(((found_t - translations[judged]).norm(dim=1) + LAMBDA_ROT * angles).mean())

    rows = np.flatnonzero(~held_out)
    stages = ["learnt", "reprojection"] if config.loss == "reprojection" else [config.loss]
    done = None
    for stage in stages:
        task = Task(
            network,
            lambda r, g, kind=stage: loss_of(kind, r, g),
            score,
            rows,
            np.ones(len(rows)),
            pretrained,
            f"PoseNet ({stage})",
        )
        done = fit(
            task,
            config.training,
            progress,
            None if checkpoint is None else checkpoint.with_suffix(f".{stage}"),
        )
    return PoseNet(backbone, config, shape, network, score(), done)


def _poses(network: PoseRegressor, pictures: Tensor) -> tuple[Tensor, Tensor]:
    network.eval()
    with torch.inference_mode():
        parts = [network(normalize_images(batch)) for batch in pictures.split(BATCH_SIZE)]
    return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])


def _seen_points(topomap: TopoMetricMap, node_ids: np.ndarray) -> Float[np.ndarray, "n k 3"]:
    """Return some points (metres, world) of each image's node, with repetitions if the node has
    fewer."""
    rng = np.random.default_rng(0)
    of_node = {}
    for node_id in np.unique(node_ids):
        node = topomap.nodes[int(node_id)]
        chosen = rng.choice(
            len(node.points_cam), POINTS_PER_IMAGE, replace=len(node.points_cam) < POINTS_PER_IMAGE
        )
        of_node[int(node_id)] = node.summary.world_from_cam.apply(
            node.points_cam[chosen].astype(np.float64)
        )
    return np.stack([of_node[int(node_id)] for node_id in node_ids]).astype(np.float32)
