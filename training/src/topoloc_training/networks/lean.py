"""Rewrite the exported graph of a finished network so that it computes the same in less time.

Both rewritings concern linear parts. A normalisation after a sum of convolutions becomes a part of
their weights. If descriptors are a sum of an enlarged coarse level and a 1x1 convolution of a fine
one, the graph returns the two levels instead of the sum
(`topoloc.features.dense.TwoLevelDescriptors`). The sum at a thousand key points costs next to
nothing. At all pixels it costs a tenth of the network.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import helper, numpy_helper


def made_lean(model: onnx.ModelProto) -> None:
    """Rewrite a network of the contract of `export.py` in place, if it has such parts."""
    _fold_normalization(model.graph)
    _give_levels(model.graph)
    onnx.checker.check_model(model)


def _fold_normalization(graph: onnx.GraphProto) -> None:
    for norm in [node for node in graph.node if node.op_type == "BatchNormalization"]:
        convolutions = _summed_convolutions(graph, norm.input[0])
        if not convolutions:
            continue
        scale, bias, mean, variance = (_values(graph, name) for name in norm.input[1:])
        epsilon = next(
            (attribute.f for attribute in norm.attribute if attribute.name == "epsilon"), 1e-5
        )
        factor = scale / np.sqrt(variance + epsilon)
        for k, convolution in enumerate(convolutions):
            weights, own_bias = (_values(graph, name) for name in convolution.input[1:3])
            _set_values(graph, convolution.input[1], weights * factor[:, None, None, None])
            _set_values(
                graph,
                convolution.input[2],
                own_bias * factor + (bias - mean * factor if k == 0 else 0.0),
            )
        for node in graph.node:
            node.input[:] = [
                norm.input[0] if name == norm.output[0] else name for name in node.input
            ]
        graph.node.remove(norm)
        _drop_unused(graph)


def _summed_convolutions(graph: onnx.GraphProto, name: str) -> list[onnx.NodeProto]:
    """Return the convolutions with a bias whose sum, enlarged or not, is a value; empty if it is
    anything else."""
    node = _maker(graph, name)
    if node is not None and node.op_type == "Add":
        parts = [_summed_convolutions(graph, one) for one in node.input]
        return [convolution for part in parts for convolution in part] if all(parts) else []
    if node is not None and node.op_type == "Resize":
        return _summed_convolutions(graph, node.input[0])
    return [node] if node is not None and node.op_type == "Conv" and len(node.input) == 3 else []


def _give_levels(graph: onnx.GraphProto) -> None:
    total = _maker(graph, "descriptors")
    if total is None or total.op_type != "Add":
        return
    parts = {
        node.op_type: node
        for node in (_maker(graph, name) for name in total.input)
        if node is not None
    }
    if set(parts) != {"Resize", "Conv"}:
        return
    enlarged, fine = parts["Resize"], parts["Conv"]
    coarse = _maker(graph, enlarged.input[0])
    weights, bias = (_values(graph, name) for name in fine.input[1:3])
    is_plain = (
        weights.shape[2:] == (1, 1) and weights.shape[1] % 4 == 0 and _doubles(graph, enlarged)
    )
    if coarse is None or coarse.op_type != "Conv" or len(coarse.input) < 3 or not is_plain:
        return
    # what enlarges adds up to one everywhere, so one bias may stand for both
    _set_values(graph, coarse.input[2], _values(graph, coarse.input[2]) + bias)
    graph.initializer.append(
        numpy_helper.from_array(
            np.ascontiguousarray(weights[:, :, 0, 0].T, np.float32), "fine_of_both"
        )
    )
    last = [0, 2, 3, 1]  # numbers of one pixel beside each other
    graph.node.extend(
        [
            helper.make_node("Transpose", [coarse.output[0]], ["coarse"], name="coarse", perm=last),
            helper.make_node("Transpose", [fine.input[0]], ["fine"], name="fine", perm=last),
            helper.make_node("Identity", ["fine_of_both"], ["fine_weights"], name="fine_weights"),
        ]
    )
    for node in (total, enlarged, fine):
        graph.node.remove(node)
    size, narrow = weights.shape[:2]
    levels = {
        "coarse": [1, "h_coarse", "w_coarse", size],
        "fine": [1, "h_fine", "w_fine", narrow],
        "fine_weights": [narrow, size],
    }
    outputs = [output for output in graph.output if output.name != "descriptors"]
    outputs[1:1] = [
        helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)
        for name, shape in levels.items()
    ]
    del graph.output[:]
    graph.output.extend(outputs)
    _drop_unused(graph)


def _doubles(graph: onnx.GraphProto, resize: onnx.NodeProto) -> bool:
    """Return whether it doubles rows and columns, bilinearly, with fixed borders."""
    attributes = {attribute.name: attribute.s.decode() for attribute in resize.attribute}
    mode, coordinates = (
        attributes.get("mode"),
        attributes.get("coordinate_transformation_mode", "half_pixel"),
    )
    scales = _maker(graph, resize.input[2]) if len(resize.input) == 3 else None
    if (
        mode != "linear"
        or not coordinates.endswith("half_pixel")
        or scales is None
        or scales.op_type != "Constant"
    ):
        return False
    return numpy_helper.to_array(scales.attribute[0].t).tolist() == [1.0, 1.0, 2.0, 2.0]


def _maker(graph: onnx.GraphProto, name: str) -> onnx.NodeProto | None:
    return next((node for node in graph.node if name in node.output), None)


def _values(graph: onnx.GraphProto, name: str) -> np.ndarray:
    found = next(value for value in graph.initializer if value.name == name)
    return numpy_helper.to_array(found).astype(np.float64)


def _set_values(graph: onnx.GraphProto, name: str, values: np.ndarray) -> None:
    found = next(value for value in graph.initializer if value.name == name)
    found.CopyFrom(numpy_helper.from_array(values.astype(np.float32), name))


def _drop_unused(graph: onnx.GraphProto) -> None:
    used = {name for node in graph.node for name in node.input}
    for value in [value for value in graph.initializer if value.name not in used]:
        graph.initializer.remove(value)
