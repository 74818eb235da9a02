"""Tracing of a network into a list of plain operations.

The list records the calls of the network's own ``forward`` for one image, so the two cannot differ.
If ``forward`` branches on values, the list contains the operation on which it branches.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from dmrl.learn.networks.architectures import INPUT_CHANNELS, Network
from dmrl.learn.networks.graph_ops import IMAGE_NAME, Array, Op

OP_KINDS = {
    "relu": "relu",
    "add": "add",
    "iadd": "add",
    "max_pool2d": "max_pool",
    "cat": "concatenate",
}
"""Kind of an operation by the name of its torch function."""
VALUE_PRESERVING_FUNCTIONS = ("float", "to", "contiguous", "detach", "clone")
"""Functions that do not change values."""
IDENTITY_MODULES = (nn.Identity, nn.Dropout, nn.Dropout2d)
"""Modules that do nothing in evaluation mode."""
TRACE_CELLS = 16
"""Side of the traced image, in grid cells."""


def trace_operations(network: Network) -> list[Op]:
    """Trace the operations of a network in evaluation mode, from the image to the output."""
    side_px = TRACE_CELLS * network.stride_px
    image = next(network.parameters()).new_zeros(1, INPUT_CHANNELS, side_px, side_px)
    training = network.training
    recorder = _Recorder(image)
    hooks = [
        hook
        for name, module in network.eval().named_modules()
        if _is_leaf(module)
        for hook in (
            module.register_forward_pre_hook(recorder.enter_module),
            module.register_forward_hook(partial(recorder.leave_module, name)),
        )
    ]
    try:
        with torch.inference_mode(), recorder:
            result = network(image)
    finally:
        network.train(training)
        for hook in hooks:
            hook.remove()
    return [*recorder.ops, Op("output", "output", recorder.source_names((result,)))]


def _is_leaf(module: nn.Module) -> bool:
    """Return whether a module counts as one operation."""
    plain = type(module).__module__.startswith("torch.nn") and not list(module.children())
    return plain or isinstance(module, nn.Conv2d | nn.BatchNorm2d)


class _Recorder(TorchFunctionMode):
    """Records the operations on an image: leaf modules, and torch functions outside of them."""

    def __init__(self, image: Tensor) -> None:
        super().__init__()
        self.ops = [Op("image", IMAGE_NAME)]
        self._name_of = {id(image): IMAGE_NAME}
        self._kept = [image]  # an id is unique only while its tensor is alive
        self._inside = 0

    def source_names(self, values: Iterable[Any]) -> tuple[str, ...]:
        """Return the names of the operations that produced these values, without unknown ones."""
        flat = (
            v for value in values for v in (value if isinstance(value, list | tuple) else [value])
        )
        return tuple(self._name_of[id(v)] for v in flat if id(v) in self._name_of)

    def enter_module(self, _module: nn.Module, _args: Any) -> None:
        """Register that a leaf module starts (forward pre-hook)."""
        self._inside += 1

    def leave_module(self, name: str, module: nn.Module, args: Any, out: Tensor) -> None:
        """Append the operation of a leaf module (forward hook)."""
        self._inside -= 1
        if isinstance(module, IDENTITY_MODULES):
            self._name_output(out, self.source_names(args)[0])
        else:
            self._append_op(_op_from_module(module, name, self.source_names(args)), out)

    def _append_op(self, op: Op, out: Tensor) -> None:
        self.ops.append(op)
        self._name_output(out, op.name)

    def _name_output(self, out: Tensor, name: str) -> None:
        self._name_of[id(out)] = name
        self._kept.append(out)

    def __torch_function__(
        self, func: Any, _types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Call the function and append its operation."""
        out = func(*args, **(kwargs or {}))
        sources = self.source_names(args)
        if self._inside or not isinstance(out, Tensor) or not sources:
            return out
        called = str(getattr(func, "__name__", func)).strip("_")
        if called in VALUE_PRESERVING_FUNCTIONS:
            self._name_output(out, sources[0])
        else:
            count = sum(op.name.startswith(called) for op in self.ops)
            name = f"{called}_{count}" if count else called
            self._append_op(_op_from_function(called, name, sources, args, kwargs or {}), out)
        return out


def _op_from_function(
    called: str, name: str, sources: tuple[str, ...], args: tuple[Any, ...], named: dict[str, Any]
) -> Op:
    kind = OP_KINDS.get(called, called)
    if kind == "max_pool":
        given = dict(
            zip(("kernel", "stride", "padding", "dilation", "ceil"), args[1:], strict=False)
        )
        given |= {key.removesuffix("_size").removesuffix("_mode"): v for key, v in named.items()}
        return Op(kind, name, sources, {}, _pool_settings(given))
    if kind == "add" and (len(sources) != 2 or named):
        kind = "add of a number"
    return Op(kind, name, sources)


def _pool_settings(given: dict[str, Any]) -> dict[str, Any]:
    """Return kernel and stride of a max-pool, and each further setting that is not the default."""
    usual: dict[str, Any] = {"padding": 0, "dilation": 1, "ceil": False}
    values = {k: _collapse_pair(v) for k, v in given.items() if k in usual}
    odd = {k: v for k, v in values.items() if v != usual[k]}
    kernel = _collapse_pair(given["kernel"])
    return {"kernel": kernel, "stride": _collapse_pair(given.get("stride") or kernel), **odd}


def _op_from_module(module: nn.Module, name: str, sources: tuple[str, ...]) -> Op:
    if isinstance(module, nn.Conv2d):
        return _op_from_conv(module, name, sources)
    if isinstance(module, nn.BatchNorm2d):
        return Op("norm", name, sources, _batch_norm_affine(module))
    if isinstance(module, nn.ReLU):
        return Op("relu", name, sources)
    if isinstance(module, nn.MaxPool2d):
        asked = ("kernel_size", "stride", "padding", "dilation", "ceil_mode")
        given = {key.split("_")[0]: getattr(module, key) for key in asked}
        return Op("max_pool", name, sources, {}, _pool_settings(given))
    return Op(type(module).__name__, name, sources)


def _op_from_conv(module: nn.Conv2d, name: str, sources: tuple[str, ...]) -> Op:
    bias = torch.zeros(module.out_channels) if module.bias is None else module.bias
    settings = {
        "stride": _collapse_pair(module.stride),
        "dilation": _collapse_pair(module.dilation),
        "padding": _collapse_pair(module.padding),
        "groups": module.groups,
    }
    if module.padding_mode != "zeros":
        settings["padding_mode"] = module.padding_mode
    values = {"weight": _to_array(module.weight), "bias": _to_array(bias)}
    return Op("conv", name, sources, values, settings)


def _batch_norm_affine(module: nn.BatchNorm2d) -> dict[str, Array]:
    """Return the factor and the summand per channel of a batch normalisation in evaluation mode."""
    assert module.running_mean is not None
    assert module.running_var is not None
    mean, variance = _to_array(module.running_mean), _to_array(module.running_var)
    weight = np.ones_like(mean) if module.weight is None else _to_array(module.weight)
    bias = np.zeros_like(mean) if module.bias is None else _to_array(module.bias)
    factor = weight / np.sqrt(variance + module.eps)
    return {"factor": factor, "summand": bias - mean * factor}


def _collapse_pair(pair: Any) -> Any:
    return pair[0] if isinstance(pair, tuple | list) and len(set(pair)) == 1 else pair


def _to_array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)
