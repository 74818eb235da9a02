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

from dmrl.learn.networks.architectures import CHANNELS, Network
from dmrl.learn.networks.graph_ops import IMAGE, Array, Op

KINDS = {
    "relu": "relu",
    "add": "add",
    "iadd": "add",
    "max_pool2d": "max_pool",
    "cat": "concatenate",
}
"""Kind of an operation by the name of its torch function."""
PASSED_ON = ("float", "to", "contiguous", "detach", "clone")
"""Functions that do not change values."""
SAME = (nn.Identity, nn.Dropout, nn.Dropout2d)
"""Modules that do nothing in evaluation mode."""
CELLS = 16
"""Side of the traced image, in grid cells."""


def operations(network: Network) -> list[Op]:
    """Trace the operations of a network in evaluation mode, from the image to the output."""
    side_px = CELLS * network.stride_px
    image = next(network.parameters()).new_zeros(1, CHANNELS, side_px, side_px)
    training = network.training
    recorder = _Recorder(image)
    hooks = [
        hook
        for name, module in network.eval().named_modules()
        if _is_one(module)
        for hook in (
            module.register_forward_pre_hook(recorder.enter),
            module.register_forward_hook(partial(recorder.leave, name)),
        )
    ]
    try:
        with torch.inference_mode(), recorder:
            result = network(image)
    finally:
        network.train(training)
        for hook in hooks:
            hook.remove()
    return [*recorder.ops, Op("output", "output", recorder.names((result,)))]


def _is_one(module: nn.Module) -> bool:
    """Return whether a module counts as one operation."""
    plain = type(module).__module__.startswith("torch.nn") and not list(module.children())
    return plain or isinstance(module, nn.Conv2d | nn.BatchNorm2d)


class _Recorder(TorchFunctionMode):
    """Records the operations on an image: leaf modules, and torch functions outside of them."""

    def __init__(self, image: Tensor) -> None:
        super().__init__()
        self.ops = [Op("image", IMAGE)]
        self._name_of = {id(image): IMAGE}
        self._kept = [image]  # an id is unique only while its tensor is alive
        self._inside = 0

    def names(self, values: Iterable[Any]) -> tuple[str, ...]:
        """Return the names of the operations that produced these values, without unknown ones."""
        flat = (
            v for value in values for v in (value if isinstance(value, list | tuple) else [value])
        )
        return tuple(self._name_of[id(v)] for v in flat if id(v) in self._name_of)

    def enter(self, _module: nn.Module, _args: Any) -> None:
        """Register that a leaf module starts (forward pre-hook)."""
        self._inside += 1

    def leave(self, name: str, module: nn.Module, args: Any, out: Tensor) -> None:
        """Append the operation of a leaf module (forward hook)."""
        self._inside -= 1
        if isinstance(module, SAME):
            self._call(out, self.names(args)[0])
        else:
            self._note(_of_module(module, name, self.names(args)), out)

    def _note(self, op: Op, out: Tensor) -> None:
        self.ops.append(op)
        self._call(out, op.name)

    def _call(self, out: Tensor, name: str) -> None:
        self._name_of[id(out)] = name
        self._kept.append(out)

    def __torch_function__(
        self, func: Any, _types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Call the function and append its operation."""
        out = func(*args, **(kwargs or {}))
        sources = self.names(args)
        if self._inside or not isinstance(out, Tensor) or not sources:
            return out
        called = str(getattr(func, "__name__", func)).strip("_")
        if called in PASSED_ON:
            self._call(out, sources[0])
        else:
            count = sum(op.name.startswith(called) for op in self.ops)
            name = f"{called}_{count}" if count else called
            self._note(_of_function(called, name, sources, args, kwargs or {}), out)
        return out


def _of_function(
    called: str, name: str, sources: tuple[str, ...], args: tuple[Any, ...], named: dict[str, Any]
) -> Op:
    kind = KINDS.get(called, called)
    if kind == "max_pool":
        given = dict(
            zip(("kernel", "stride", "padding", "dilation", "ceil"), args[1:], strict=False)
        )
        given |= {key.removesuffix("_size").removesuffix("_mode"): v for key, v in named.items()}
        return Op(kind, name, sources, {}, _pooling(given))
    if kind == "add" and (len(sources) != 2 or named):
        kind = "add of a number"
    return Op(kind, name, sources)


def _pooling(given: dict[str, Any]) -> dict[str, Any]:
    """Return kernel and stride of a max-pool, and each further setting that is not the default."""
    usual: dict[str, Any] = {"padding": 0, "dilation": 1, "ceil": False}
    odd = {k: _one(v) for k, v in given.items() if k in usual and _one(v) != usual[k]}
    kernel = _one(given["kernel"])
    return {"kernel": kernel, "stride": _one(given.get("stride") or kernel), **odd}


def _of_module(module: nn.Module, name: str, sources: tuple[str, ...]) -> Op:
    if isinstance(module, nn.Conv2d):
        return _of_conv(module, name, sources)
    if isinstance(module, nn.BatchNorm2d):
        return Op("norm", name, sources, _of_norm(module))
    if isinstance(module, nn.ReLU):
        return Op("relu", name, sources)
    if isinstance(module, nn.MaxPool2d):
        asked = ("kernel_size", "stride", "padding", "dilation", "ceil_mode")
        given = {key.split("_")[0]: getattr(module, key) for key in asked}
        return Op("max_pool", name, sources, {}, _pooling(given))
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
    """Return the factor and the summand per channel of a batch normalisation in evaluation mode."""
    assert module.running_mean is not None
    assert module.running_var is not None
    mean, variance = _array(module.running_mean), _array(module.running_var)
    weight = np.ones_like(mean) if module.weight is None else _array(module.weight)
    bias = np.zeros_like(mean) if module.bias is None else _array(module.bias)
    factor = weight / np.sqrt(variance + module.eps)
    return {"factor": factor, "summand": bias - mean * factor}


def _one(pair: Any) -> Any:
    return pair[0] if isinstance(pair, tuple | list) and len(set(pair)) == 1 else pair


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)
