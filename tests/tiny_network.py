"""The smallest file that is a network of local features by our contract."""

from __future__ import annotations

from pathlib import Path

import onnx
from onnx import TensorProto, helper


def write_network(path: Path, name: str = "xfeat", version: str = "1", outputs: tuple[str, str] = ("scores", "descriptors")) -> Path:
    """The smallest network of the contract: the picture as its scores, a descriptor of its means."""
    nodes = [
        helper.make_node("Identity", ["image"], [outputs[0]]),
        helper.make_node("AveragePool", ["image"], [outputs[1]], kernel_shape=[8, 8], strides=[8, 8]),
    ]
    values = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 1, None, None]) for n in ("image", *outputs)]
    model = helper.make_model(helper.make_graph(nodes, "tiny", values[:1], values[1:]), opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    helper.set_model_props(model, {"topoloc_network": name, "topoloc_version": version})
    onnx.save(model, path)
    return path
