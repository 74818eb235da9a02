"""C file and header of a network: the values of their templates."""

from dataclasses import dataclass
from typing import Any

from dmrl.deploy.c.buffer_plan import BufferPlan, plan_buffers
from dmrl.deploy.c.placement import Placement, place_buffers
from dmrl.deploy.c.row_schedule import Step, slides_along_row
from dmrl.deploy.c.templating import fill_template
from dmrl.deploy.int8.layers import GAIN_SHIFT, Conv
from dmrl.deploy.int8.network import SUBPIXEL, IntegerNetwork
from dmrl.errors import ModelError
from dmrl.learn.inference.decode_grids import DUPLICATE_RADIUS_PX

MAX_STACK_BYTES = 640
"""Maximum stack of the C on a 32-bit core, optimised; `dmrl verify` measures it."""
C_TYPES = {False: ("u8", "uint8_t"), True: ("s8", "int8_t")}


@dataclass(frozen=True, slots=True)
class CSource:
    """Generated C of a network.

    Parameters
    ----------
    code, header
        Text of the two files.
    values
        Values of their templates, sizes in bytes among them.
    """

    code: str
    header: str
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Kernel:
    """A kernel for input tensors of given types.

    Parameters
    ----------
    template
        Its template, without the folder.
    signed
        Whether each tensor that it reads is int8; else uint8.
    """

    template: str
    signed: tuple[bool, ...]

    @property
    def types(self) -> list[str]:
        """C types of the tensors."""
        return [C_TYPES[each][1] for each in self.signed]

    @property
    def suffix(self) -> str:
        """End of its name in C."""
        return "_".join(C_TYPES[each][0] for each in self.signed)


@dataclass(frozen=True, slots=True)
class KernelCall:
    """A convolution kernel with a layer's constants; layers that agree share machine code.

    Parameters
    ----------
    kernel
        The kernel.
    shortcut
        Whether it adds a shortcut.
    cols
        Columns of the output.
    shape
        Further arguments, by name.
    signed
        Whether the output is int8.
    shift
        Shift of the requantization.
    """

    kernel: Kernel
    shortcut: bool
    cols: int
    shape: tuple[tuple[str, int], ...]
    signed: bool
    shift: int


def generate_source(
    network: IntegerNetwork, names: dict[str, str], *, bayer: bool, near_bytes: int | None = None
) -> CSource:
    """Generate the C file and the header of a network.

    Parameters
    ----------
    network
        The network.
    names
        Names from `template_values`.
    bayer
        Whether images are raw Bayer mosaics by default; a compiler flag overrides it.
    near_bytes
        Bytes of the near memory; rings that do not fit are placed in a far one, see `placement`.
        None: one memory.

    Raises
    ------
    ModelError
        If the C does not support the network; the message contains the layer's name.
    SettingError
        If the near memory is too small.
    """
    plan = plan_buffers(network)
    require_supported(plan)
    placement = place_buffers(plan, near_bytes)
    calls = [_build_call(plan, step) for step in plan.steps]
    unique = list(dict.fromkeys(call for call in calls if call))
    values: dict[str, Any] = {
        **names,
        **_state_arguments(placement, names["prefix"]),
        **_count_bytes(placement),
        "network": network,
        "plan": plan,
        "placement": placement,
        "bayer": bayer,
        "kernels": list(dict.fromkeys(k for step in plan.steps for k in _list_kernels(plan, step))),
        "kernel_of": [_list_kernels(plan, step)[-1] for step in plan.steps],
        "calls": unique,
        "call_of": [unique.index(call) if call else None for call in calls],
        "gain_shift": GAIN_SHIFT,
        "cell_q4": network.stride_px * SUBPIXEL,
        "near_q4": int(DUPLICATE_RADIUS_PX * SUBPIXEL),
    }
    return CSource(
        fill_template("network.c", **values), fill_template("network.h", **values), values
    )


def require_supported(plan: BufferPlan) -> None:
    """Raise ModelError unless the C has a kernel for every layer.

    Raises
    ------
    ModelError
        If a layer is not supported; the message contains its name.
    """
    for step in plan.steps:
        if isinstance(step.layer, Conv) and step.layer.depthwise and step.layer.kernel != 3:
            raise ModelError(
                f"layer {step.layer.name} is a depthwise 1x1 convolution, which the C does not "
                "support. Fold it into the convolution before it"
            )


def _state_arguments(placement: Placement, prefix: str) -> dict[str, str]:
    """Return the state as parameters of the generated functions, and as arguments."""
    kinds = {"net": f"{prefix}_t"} | ({"away": f"{prefix}_far_t"} if placement.far else {})
    return {
        "params": ", ".join(f"{kind} *{name}" for name, kind in kinds.items()),
        "args": ", ".join(kinds),
        "refs": ", ".join(f"&{name}" for name in kinds),
        "unused": "".join(f"(void){name}; " for name in kinds).rstrip(),
    }


def _count_bytes(placement: Placement) -> dict[str, int]:
    """Return the sizes that the header and the README state."""
    plan, near = placement.plan, placement.near_bytes(bayer=False)
    convs = [step.layer for step in plan.steps if isinstance(step.layer, Conv)]
    tables = sum(c.weight.size + 8 * c.bias.size + 4 * c.gain.size for c in convs)
    return {
        "state_bytes": near,
        "bayer_bytes": placement.near_bytes(bayer=True) - near,
        "constant_bytes": tables
        + 512 * len(plan.network.heads)
        + (0 if placement.far else plan.zero_bytes),
        "stack_bytes": MAX_STACK_BYTES,
    }


def _list_kernels(plan: BufferPlan, step: Step) -> list[Kernel]:
    """Return the kernels that a step needs; the last is the one that it calls."""
    signed = tuple(plan.buffers[k].signed for k in step.sources)
    conv = step.layer
    if not isinstance(conv, Conv):
        return [Kernel(conv.kind, signed)]
    if conv.depthwise:
        return [Kernel("depthwise_along" if slides_along_row(conv) else "depthwise", signed)]
    called = Kernel("convolve_pool" if step.pooled else "convolve", signed)
    return [Kernel("dense", signed[:1]), called]


def _build_call(plan: BufferPlan, step: Step) -> KernelCall | None:
    """Return the call of a convolution's kernel; None for other layers."""
    conv, source = step.layer, plan.buffers[step.sources[0]]
    if not isinstance(conv, Conv):
        return None
    width, kernel = source.channels, _list_kernels(plan, step)[-1]
    taps, stride = step.reads.taps, conv.stride * width
    shapes = {
        "depthwise_along": {"channels": width, "dilation": conv.dilation, "pad": conv.pad_value},
        "depthwise": {"across": conv.dilation * width, "step": stride, "channels": width},
    }
    run = width * conv.kernel**2 // taps
    dense = {"taps": taps, "run": run, "step": stride, "outs": len(conv.bias)}
    shape = tuple(shapes.get(kernel.template, dense).items())
    shortcut, cols = len(step.sources) > 1, plan.output_of(step).cols
    return KernelCall(kernel, shortcut, cols, shape, conv.signed, conv.shift)
