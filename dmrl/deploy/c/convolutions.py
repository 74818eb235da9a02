"""C of convolutions: the kernel of each step and the rows that it reads."""

from collections.abc import Iterator
from dataclasses import dataclass

from dmrl.deploy.c.buffer_plan import Plan, along, taps_of
from dmrl.deploy.c.memory_levels import rows_read
from dmrl.deploy.c.row_addresses import RANGES, TYPES, Desk, body, plus, suffixes
from dmrl.deploy.c.row_schedule import Step
from dmrl.deploy.c.templating import wrapped
from dmrl.deploy.int8.network import Conv


@dataclass(frozen=True, slots=True)
class Kernel:
    """A kernel with a layer's constants; layers that agree in both share machine code.

    Parameters
    ----------
    name
        Name of the kernel in its template.
    shortcut
        Whether it adds a shortcut.
    constants
        Arguments that define the layer's shape.
    """

    name: str
    shortcut: bool
    constants: str


def templates_of(step: Step, conv: Conv) -> list[str]:
    """Return the template files of a step's kernel."""
    if conv.depthwise:
        return ["depthwise_along.c" if along(conv) else "depthwise.c"]
    return ["dense.c", "convolve_pool.c" if step.pooled else "convolve.c"]


def shared_kernels(plan: Plan) -> str:
    """Generate one C function per kernel, with its constants."""
    text = ""
    for number, kernel in enumerate(_kernels(plan)):
        kinds = ["const uint8_t *const *in", "uint8_t *out", "const int8_t *weights"]
        kinds += ["const scale_t *scales"]
        words = ["in", "out", "weights", "scales"]
        if kernel.shortcut:
            kinds += ["const uint8_t *shortcut", "const int32_t *gains"]
            words += ["shortcut", "gains"]
        text += (
            f"APART void convolution_{number}({', '.join(kinds[:3])},\n"
            f"    {', '.join(kinds[3:])})\n{{\n"
            f"    {kernel.name}({', '.join(words)},\n        {kernel.constants});\n}}\n\n"
        )
    return text


def _kernels(plan: Plan) -> list[Kernel]:
    """Return every kernel that a step requires, without duplicates."""
    return list(dict.fromkeys(kernel for _, kernel in _convolutions(plan)))


def _convolutions(plan: Plan) -> Iterator[tuple[int, Kernel]]:
    for index, step in enumerate(plan.steps):
        if isinstance(step.layer, Conv):
            yield index, _kernel(plan, index, step, step.layer)


def _kernel(plan: Plan, index: int, step: Step, conv: Conv) -> Kernel:
    inputs, out = [plan.buffers[k] for k in step.sources], plan.buffers[index + 1]
    outs, width = conv.weight.shape[0], inputs[0].channels
    name, stride = TYPES[inputs[0].signed][0], conv.stride * width
    if conv.depthwise and along(conv):
        name = f"depthwise_along_{name}"
        shape = f"/* channels */ {width}, /* dilation */ {conv.dilation}, "
        shape += f"/* pad */ {conv.pad_value}"
    elif conv.depthwise:
        name = f"depthwise_{name}"
        shape = f"/* across */ {conv.dilation * width}, /* step */ {stride}, /* channels */ {width}"
    else:
        name = f"convolve{'_pool' if step.pooled else ''}_{suffixes([b.signed for b in inputs])}"
        taps = taps_of(conv)
        run = width if taps == conv.kernel**2 else width * conv.kernel
        shape = f"/* taps */ {taps}, /* run */ {run}, /* step */ {stride}, /* outs */ {outs}"
    adds = "/* adds */ 1, " if inputs[1:] else "0, 0, /* adds */ 0, "
    plain = conv.depthwise or step.pooled
    numbers = f"{'' if plain else adds}/* cols */ {out.cols}, {shape},\n        "
    numbers += f"/* range */ {RANGES[conv.signed]}, /* shift */ {conv.shift}"
    return Kernel(name, bool(inputs[1:]), numbers)


def row_of_convolution(desk: Desk, index: int) -> str:
    """Generate the row pointers of a kernel and its call.

    A pooled step computes two rows at once and has twice as many pointers.
    """
    step, conv = desk.plan.steps[index], desk.plan.steps[index].layer
    assert isinstance(conv, Conv)
    source, taps = desk.plan.buffers[step.sources[0]], taps_of(conv)
    count = rows_read(step)
    row = _row(step.stride, _row_of_pointer(step, conv, taps))
    padding = 0 if along(conv) else conv.padding
    start = plus((source.gap - padding) * source.channels)
    spread = conv.dilation * source.channels
    column = f" + k % {conv.kernel} * {spread}" if taps > conv.kernel else ""
    pointer = "k" if count > 1 else "0"
    place = f"{desk.read(0, source, row, pointer)}{start}{column}"
    lines = [f"const uint8_t *const in[1] = {{{place}}};"]
    if count > 1:
        lines = [
            f"const uint8_t *in[{count}];",
            f"for (int k = 0; k < {count}; k++)",
            f"    in[k] = {place};",
        ]
    return body([*lines, *_call(desk, index)])


def _call(desk: Desk, index: int) -> list[str]:
    plan, step, out = desk.plan, desk.plan.steps[index], desk.plan.buffers[index + 1]
    kernel = dict(_convolutions(plan))[index]
    words = ["in", desk.target(out)]
    words += [desk.table(kind, f"{step.name}_{kind}") for kind in ("weights", "scales")]
    if kernel.shortcut:
        words.append(desk.values(1, plan.buffers[step.sources[1]]))
        words.append(desk.table("gains", f"{step.name}_gains"))
    call = f"convolution_{_kernels(plan).index(kernel)}("
    return [
        call,
        *wrapped([f"{w}," for w in words[:-1]] + [f"{words[-1]});"], "    "),
        *desk.sent(out),
    ]


def _row(factor: int, offset: str) -> str:
    """Return the input row of output row ``row`` as C text."""
    return (f"{factor} * row" if factor > 1 else "row") + offset


def _row_of_pointer(step: Step, conv: Conv, taps: int) -> str:
    """Return the input row of pointer ``k``, relative to the first row under the kernel."""
    terms = [f" - {conv.padding}"] if conv.padding else []
    within = f"k % {taps}" if step.pooled else "k"
    if taps > conv.kernel:
        terms.append(f" + {within} / {conv.kernel} * {conv.dilation}")
    elif conv.kernel > 1:
        terms.append(f" + {within}{_times(conv.dilation)}")
    if step.pooled:
        output = f"k / {taps}" if taps > 1 else "k"
        terms.append(f" + {output}{_times(conv.stride)}")
    return "".join(terms)


def _times(factor: int) -> str:
    return f" * {factor}" if factor > 1 else ""
