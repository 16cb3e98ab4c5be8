"""Write the smallest network file of local features that follows topoloc's contract."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

STRIDE = 8


def cells(descriptor_size: int = 64) -> np.ndarray:
    """Return the descriptor weights: each element is one weighted sum over the pixels of a cell."""
    return (
        np.random.default_rng(0)
        .normal(size=(descriptor_size, 1, STRIDE, STRIDE))
        .astype(np.float32)
    )


def write_network(
    path: Path,
    name: str = "xfeat",
    version: str = "1",
    outputs: tuple[str, ...] = ("scores", "descriptors"),
    descriptor_size: int = 64,
) -> Path:
    """Write a network with the image as scores and sums over each cell as descriptors. A third
    output, if named, has means of eight by eight pixels."""
    nodes = [
        helper.make_node("Identity", ["image"], [outputs[0]]),
        helper.make_node(
            "Conv",
            ["image", "cells"],
            [outputs[1]],
            kernel_shape=[STRIDE, STRIDE],
            strides=[STRIDE, STRIDE],
        ),
    ]
    sizes = {"image": 1, outputs[0]: 1, outputs[1]: descriptor_size}
    if len(outputs) > 2:
        nodes.append(
            helper.make_node(
                "AveragePool",
                ["image"],
                [outputs[2]],
                kernel_shape=[STRIDE, STRIDE],
                strides=[STRIDE, STRIDE],
            )
        )
        sizes[outputs[2]] = 1
    values = [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, size, None, None])
        for n, size in sizes.items()
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        values[:1],
        values[1:],
        [numpy_helper.from_array(cells(descriptor_size), "cells")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    helper.set_model_props(model, {"topoloc_network": name, "topoloc_version": version})
    onnx.save(model, path)
    return path
