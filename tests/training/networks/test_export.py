"""Check that each network is exported by one contract and gives PyTorch's outputs in ONNX
Runtime, at any size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn
from torch.nn import functional

from topoloc.features.network_files import NETWORKS, NetworkInfo, load_onnxruntime
from topoloc_training.net.network import TopolocNet
from topoloc_training.networks.edgepoint2 import EdgePoint2
from topoloc_training.networks.export import build_network, convert, export
from topoloc_training.networks.xfeat import XFeat


def of_random_weights(network: nn.Module) -> nn.Module:
    """Set random weights and batch-norm averages, so that a missing one changes the output."""
    torch.manual_seed(0)
    for norm in (module for module in network.modules() if isinstance(module, nn.BatchNorm2d)):
        norm.running_mean.normal_(0, 0.1)
        norm.running_var.uniform_(0.5, 1.5)
    return network.eval()


def picture(height: int, width: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    coarse = torch.rand(1, 1, height // 8, width // 8, generator=generator)
    return functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)


@pytest.mark.parametrize(
    ("kind", "network", "length", "stride"),
    [
        ("xfeat", XFeat, 64, 8),
        ("edgepoint2-t32", lambda: EdgePoint2("t32"), 32, 4),
        ("edgepoint2-e64", lambda: EdgePoint2("e64"), 64, 4),
        ("topoloc-net", TopolocNet, 64, 4),
    ],
)
def test_the_exported_network_answers_as_the_original(
    kind: str, network: type, length: int, stride: int, tmp_path: Path
):
    original = of_random_weights(network())
    path = tmp_path / "network.onnx"
    export(original, path, {"topoloc_network": kind})
    assert NetworkInfo.of_file(path) == NETWORKS[kind]
    session = load_onnxruntime().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for height, width in ((96, 160), (160, 64)):
        image = picture(height, width)
        answers = {
            output.name: value
            for output, value in zip(
                session.get_outputs(), session.run(None, {"image": image.numpy()}), strict=True
            )
        }
        scores, places, descriptors = (
            answers["scores"],
            answers.get("places"),
            _descriptors(answers),
        )
        with torch.no_grad():
            expected = original(image)
        assert scores.shape == (1, 1, height, width)
        assert descriptors.shape == (1, length, height // stride, width // stride)
        assert 0 <= scores.min() < scores.max() <= 1
        np.testing.assert_allclose(scores, expected[0].numpy(), atol=1e-4)
        np.testing.assert_allclose(descriptors, expected[1].numpy(), atol=1e-3)
        assert (places is not None) == ("coarse" in answers) == (kind == "topoloc-net")
        if places is not None:
            assert places.shape == (1, 64, height // 16, width // 16)
            np.testing.assert_allclose(places, expected[2].numpy(), atol=1e-3)


def _descriptors(answers: dict[str, np.ndarray]) -> np.ndarray:
    """Return the descriptors as one output, also from two levels."""
    if "descriptors" in answers:
        return answers["descriptors"]
    coarse = torch.from_numpy(answers["coarse"]).permute(0, 3, 1, 2)
    enlarged = functional.interpolate(coarse, scale_factor=2, mode="bilinear").numpy()
    return enlarged + np.einsum("bhwk,kc->bchw", answers["fine"], answers["fine_weights"])


def test_normalisations_of_sums_become_weights(tmp_path: Path):
    path = tmp_path / "network.onnx"
    export(of_random_weights(TopolocNet()), path, {"topoloc_network": "topoloc-net"})
    graph = onnx.load(path).graph
    assert not [node for node in graph.node if node.op_type == "BatchNormalization"]
    assert {name for node in graph.node for name in node.input} >= {
        value.name for value in graph.initializer
    }


def test_the_cheap_tail_of_xfeat_is_softmax_times_enlarged_reliability():
    network = of_random_weights(XFeat())
    image = picture(96, 128)
    with torch.no_grad():
        scores, _ = network(image)
        _, logits, reliability = network.maps(image)
        first = network.keypoint_head(functional.pixel_unshuffle(network.norm(image), 8))
    cells = functional.pixel_shuffle(torch.softmax(first, 1)[:, :64], 8)
    expected = cells * functional.interpolate(
        reliability, scale_factor=8, mode="bilinear", align_corners=False
    )
    np.testing.assert_allclose(logits.numpy(), first.numpy(), atol=1e-4)
    np.testing.assert_allclose(scores.numpy(), expected.numpy(), atol=1e-6)


def test_weights_of_another_network_are_refused():
    tensors = EdgePoint2("s64").state_dict()
    assert isinstance(build_network("edgepoint2-s64", tensors), EdgePoint2)
    with pytest.raises(ValueError, match="not the weights of edgepoint2-m64"):
        build_network("edgepoint2-m64", tensors)
    with pytest.raises(ValueError, match="no network 'superpoint'"):
        build_network("superpoint", tensors)


def test_published_weights_answer_as_published(shared: Path, tmp_path: Path):
    weights = shared / "weights"
    if not weights.is_dir():
        pytest.skip(f"no weights at {weights}")
    image = picture(96, 160).numpy()
    convert(
        "xfeat",
        (weights / "xfeat" / "xfeat.pt").read_bytes(),
        tmp_path / "xfeat.onnx",
        {"topoloc_network": "xfeat"},
    )
    runs = [
        load_onnxruntime().InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for path in (tmp_path / "xfeat.onnx", weights / "xfeat" / "xfeat_own_dyn.onnx")
    ]
    scores, descriptors = runs[0].run(None, {"image": image})
    expected, logits, _ = runs[1].run(None, {"gray": image})
    np.testing.assert_allclose(descriptors, expected, atol=1e-3)
    likeliest = np.argmax(logits[0, :64], axis=0)
    cells = scores[0, 0].reshape(12, 8, 20, 8).transpose(0, 2, 1, 3).reshape(12, 20, 64)
    assert (
        np.mean(np.argmax(cells, axis=2) == likeliest) > 0.8
    )  # reliability changes within a cell, a little
    for size in ("T32", "S32", "S64", "M64", "E64"):
        kind = f"edgepoint2-{size.lower()}"
        convert(
            kind,
            (weights / "edgepoint2" / f"{size}.pth").read_bytes(),
            tmp_path / "out.onnx",
            {"topoloc_network": kind},
        )
        assert NetworkInfo.of_file(tmp_path / "out.onnx").name == kind
