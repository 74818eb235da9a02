"""A network as a list of plain operations, for whoever takes it elsewhere.

The list comes from the network's own ``forward``, run on symbols (torch.fx), so it cannot fall
behind it. A ``forward`` that decides by the values it sees has no such list.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch.nn import functional

from dmrl.errors import ModelError
from dmrl.learn.network import Network
from dmrl.learn.operations import IMAGE, Array, Op

FUNCTIONS: dict[Callable[..., Any] | str, str] = {
    torch.relu: "relu",
    functional.relu: "relu",
    "relu": "relu",
    "relu_": "relu",
    operator.add: "add",
    operator.iadd: "add",
    torch.add: "add",
    "add": "add",
    "add_": "add",
    torch.max_pool2d: "max_pool",
    functional.max_pool2d: "max_pool",
    torch.cat: "concatenate",
}
SAME = (nn.Identity, nn.Dropout, nn.Dropout2d)
"""Modules that do nothing once a network is trained."""


def operations(network: Network) -> list[Op]:
    """The operations of a network in use, in order; the first is the image, the last the output.

    Raises
    ------
    ModelError
        If its ``forward`` decides by values.
    """
    try:
        traced = fx.symbolic_trace(network.eval())
    except fx.proxy.TraceError as e:
        raise ModelError(
            f"{type(network).__name__}.forward decides by the values it sees ({e}). "
            "Write it as a fixed list of layers"
        ) from None
    modules = dict(traced.named_modules())
    renamed: dict[str, str] = {}
    ops: list[Op] = []
    for node in traced.graph.nodes:
        sources = tuple(renamed[source.name] for source in node.all_input_nodes)
        op = _operation(node, modules, sources)
        if op is not None:
            ops.append(op)
        renamed[node.name] = op.name if op is not None else sources[0]
    return ops


def _operation(node: fx.Node, modules: dict[str, nn.Module], sources: tuple[str, ...]) -> Op | None:
    """The operation of a node; None if it passes its input on."""
    if node.op == "placeholder":
        return Op("image", IMAGE)
    if node.op == "output":
        return Op("output", "output", sources)
    if node.op == "call_module":
        module = modules[str(node.target)]
        return None if isinstance(module, SAME) else _of_module(module, str(node.target), sources)
    kind = FUNCTIONS.get(node.target, str(getattr(node.target, "__name__", node.target)))
    if kind == "max_pool":
        kernel = node.args[1] if len(node.args) > 1 else node.kwargs["kernel_size"]
        stride = node.args[2] if len(node.args) > 2 else node.kwargs.get("stride")
        odd = {k: v for k, v in node.kwargs.items() if k not in ("kernel_size", "stride")}
        odd |= {"more": node.args[3:]} if len(node.args) > 3 else {}
        return Op(
            kind, node.name, sources, {}, {"kernel": kernel, "stride": stride or kernel, **odd}
        )
    if kind == "add" and len(sources) != 2:
        kind = "add of a number"
    return Op(kind, node.name, sources)


def _of_module(module: nn.Module, name: str, sources: tuple[str, ...]) -> Op:
    if isinstance(module, nn.Conv2d):
        return _of_conv(module, name, sources)
    if isinstance(module, nn.BatchNorm2d):
        return Op("norm", name, sources, _of_norm(module))
    if isinstance(module, nn.ReLU):
        return Op("relu", name, sources)
    if isinstance(module, nn.MaxPool2d):
        settings = {"kernel": module.kernel_size, "stride": module.stride}
        odd = {"padding": module.padding, "dilation": module.dilation, "ceil": module.ceil_mode}
        usual = {"padding": 0, "dilation": 1, "ceil": False}
        settings |= {k: v for k, v in odd.items() if v != usual[k]}
        return Op("max_pool", name, sources, {}, settings)
    return Op(type(module).__name__, name, sources)


def _of_conv(module: nn.Conv2d, name: str, sources: tuple[str, ...]) -> Op:
    bias = torch.zeros(module.out_channels) if module.bias is None else module.bias
    settings = {
        "stride": _one(module.stride),
        "dilation": _one(module.dilation),
        "padding": _one(module.padding),
        "groups": module.groups,
    }
    if module.padding_mode != "zeros":
        settings["padding_mode"] = module.padding_mode
    values = {"weight": _array(module.weight), "bias": _array(bias)}
    return Op("conv", name, sources, values, settings)


def _of_norm(module: nn.BatchNorm2d) -> dict[str, Array]:
    """What the normalisation comes to in use: a factor and a summand per channel."""
    assert module.running_mean is not None
    assert module.running_var is not None
    mean, variance = _array(module.running_mean), _array(module.running_var)
    weight = np.ones_like(mean) if module.weight is None else _array(module.weight)
    bias = np.zeros_like(mean) if module.bias is None else _array(module.bias)
    factor = weight / np.sqrt(variance + module.eps)
    return {"factor": factor, "summand": bias - mean * factor}


def _one(pair: Any) -> Any:
    return pair[0] if isinstance(pair, tuple) and len(set(pair)) == 1 else pair


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)
