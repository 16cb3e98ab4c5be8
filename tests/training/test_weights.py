"""Check that weights are validated before use, and that the fault of a file is one line."""

from __future__ import annotations

import hashlib
import io
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch

from topoloc.errors import WeightsError
from topoloc_training import weights as weights_module
from topoloc_training.backbones import Backbone, normalize_images
from topoloc_training.weights import find_weights, load_features, read_weights


def netvlad_tensors(num_clusters: int = 64) -> dict[str, torch.Tensor]:
    """Return small values under the keys and shapes of the public NetVLAD of VGG-16."""
    with torch.device("meta"):
        features = Backbone("vgg16", num_outputs=None).state_dict()
    tensors = {
        name.replace("features.", "encoder."): torch.full(value.shape, 0.01)
        for name, value in features.items()
    }
    return tensors | {
        "pool.conv.weight": torch.ones(num_clusters, 512, 1, 1),
        "pool.centroids": torch.zeros(num_clusters, 512),
    }


def test_a_file_is_read_and_identified_by_its_hash(random_file: Path):
    weights = read_weights(random_file, "squeezenet1_1")
    assert weights.sha256 == hashlib.sha256(random_file.read_bytes()).hexdigest()
    network = Backbone("squeezenet1_1", num_outputs=None, depth=5)
    load_features(network, weights)
    assert torch.equal(
        network.state_dict()["features.4.squeeze.weight"],
        weights.tensors["features.4.squeeze.weight"],
    )


def test_features_alone_are_enough(squeezenet_file: Path):
    assert not any(
        "classifier" in name for name in read_weights(squeezenet_file, "squeezenet1_1").tensors
    )


def test_weights_of_another_network_are_named(random_file: Path):
    with pytest.raises(
        WeightsError,
        match=r"not those of vgg16: features.0.weight is \(64, 3, 3, 3\)|looks like squeezenet1_1",
    ):
        read_weights(random_file, "vgg16")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_truncated_file_is_an_error(random_file: Path, tmp_path: Path, share: float):
    path = tmp_path / "cut.pth"
    data = random_file.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(WeightsError, match=r"truncated|empty"):
        read_weights(path, "squeezenet1_1")


def test_missing_and_invalid_files_are_errors(tmp_path: Path):
    with pytest.raises(WeightsError, match="cannot read weights"):
        read_weights(tmp_path / "none.pth", "squeezenet1_1")
    torch.save({"epoch": 3}, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match="no named tensors"):
        read_weights(tmp_path / "other.pth", "squeezenet1_1")


def test_numbers_that_are_not_finite_are_an_error(random_file: Path, tmp_path: Path):
    tensors = torch.load(random_file, weights_only=True)
    tensors["features.0.bias"][3] = torch.nan
    torch.save(tensors, tmp_path / "nan.pth")
    with pytest.raises(WeightsError, match=r"features.0.bias holds values that are not finite"):
        read_weights(tmp_path / "nan.pth", "squeezenet1_1")


def test_code_in_a_file_is_not_run(tmp_path: Path):
    class Evil:
        def __reduce__(self):
            return (Path(tmp_path / "touched").touch, ())

    torch.save({"features.0.weight": Evil()}, tmp_path / "evil.pth")
    with pytest.raises(WeightsError):
        read_weights(tmp_path / "evil.pth", "squeezenet1_1")
    assert not (tmp_path / "touched").exists()


def test_the_public_netvlad_checkpoint_is_understood(tmp_path: Path):
    recalls = {1: np.float64(0.85)}  # such checkpoints hold NumPy numbers beside the weights
    torch.save(
        {
            "epoch": 7,
            "state_dict": netvlad_tensors(),
            "recalls": recalls,
            "best_score": np.float64(0.85),
        },
        tmp_path / "netvlad.pth",
    )
    weights = read_weights(tmp_path / "netvlad.pth", "vgg16")
    assert weights.netvlad is not None
    assert tuple(weights.netvlad["centroids"].shape) == (64, 512)
    assert "features.28.weight" in weights.tensors
    with pytest.raises(WeightsError, match="looks like vgg16"):
        read_weights(tmp_path / "netvlad.pth", "squeezenet1_1")


def test_a_netvlad_layer_of_another_size_is_an_error(tmp_path: Path):
    tensors = netvlad_tensors()
    tensors["pool.centroids"] = torch.zeros(32, 512)
    torch.save({"state_dict": tensors}, tmp_path / "bad.pth")
    with pytest.raises(
        WeightsError, match=r"pool\.conv\.weight is \(64, 512, 1, 1\), pool\.centroids \(32, 512\)"
    ):
        read_weights(tmp_path / "bad.pth", "vgg16")


def test_offline_the_error_names_the_file_and_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def offline(*args: object, **kwargs: object):
        raise urllib.error.URLError("no route to host")

    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
    monkeypatch.setattr(urllib.request, "urlopen", offline)
    with pytest.raises(
        WeightsError,
        match=(
            r"https://\S+vgg16-397923af\.pth cannot be fetched \(no route to host\); .* put it at"
        ),
    ) as told:
        find_weights("vgg16", None)
    assert str(tmp_path / "vgg16-397923af.pth") in str(told.value)


def test_published_weights_are_fetched_once_and_their_hash_is_checked(
    random_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    data = random_file.read_bytes()
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
    monkeypatch.setattr(urllib.request, "urlopen", lambda *args, **kwargs: io.BytesIO(data))
    with pytest.raises(WeightsError, match="not as published"):
        find_weights("squeezenet1_1", None)
    assert list(tmp_path.iterdir()) == []
    name = f"squeezenet1_1-{hashlib.sha256(data).hexdigest()[:8]}.pth"
    monkeypatch.setitem(weights_module._PUBLISHED, "squeezenet1_1", name)
    assert find_weights("squeezenet1_1", None) is not None
    monkeypatch.setattr(urllib.request, "urlopen", None)  # from the cache: no second download
    assert find_weights("squeezenet1_1", None) is not None


def test_scratch_and_our_own_backbone_begin_with_nothing():
    assert find_weights("vgg16", "scratch") is None
    assert find_weights("compact", None) is None


def test_the_published_weights_load_and_distinguish_images(squeezenet_file: Path):
    network = Backbone("squeezenet1_1", num_outputs=None).eval()
    network.load_state_dict(torch.load(squeezenet_file, weights_only=True))
    checks = (torch.arange(96)[:, None] // 8 + torch.arange(96)[None] // 8) % 2
    pictures = (
        torch.stack([checks * 200, torch.full((96, 96), 128)])
        .to(torch.uint8)[..., None]
        .expand(2, 96, 96, 3)
    )
    with torch.inference_mode():
        checked, plain = network(normalize_images(pictures)).mean(dim=(2, 3))
    assert torch.nn.functional.cosine_similarity(checked, plain, dim=0) < 0.7
