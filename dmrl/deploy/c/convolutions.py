"""C of convolutions: the kernel of each step and the rows that it reads."""

from collections.abc import Iterator
from dataclasses import dataclass

from dmrl.deploy.c.buffer_plan import BufferPlan, count_pointers, slides_along_row
from dmrl.deploy.c.memory_levels import count_input_rows
from dmrl.deploy.c.row_addresses import (
    C_RANGES,
    C_TYPES,
    StepAddresses,
    indent_lines,
    join_suffixes,
    plus_text,
)
from dmrl.deploy.c.row_schedule import Step
from dmrl.deploy.c.templating import wrap_words
from dmrl.deploy.int8.network import Conv


@dataclass(frozen=True, slots=True)
class KernelCall:
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


def kernel_templates(step: Step, conv: Conv) -> list[str]:
    """Return the template files of a step's kernel."""
    if conv.depthwise:
        return ["depthwise_along.c" if slides_along_row(conv) else "depthwise.c"]
    return ["dense.c", "convolve_pool.c" if step.pooled else "convolve.c"]


def generate_shared_kernels(plan: BufferPlan) -> str:
    """Generate one C function per kernel, with its constants."""
    text = ""
    for number, kernel in enumerate(_unique_kernels(plan)):
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


def _unique_kernels(plan: BufferPlan) -> list[KernelCall]:
    """Return every kernel that a step requires, without duplicates."""
    return list(dict.fromkeys(kernel for _, kernel in _iter_convolutions(plan)))


def _iter_convolutions(plan: BufferPlan) -> Iterator[tuple[int, KernelCall]]:
    for index, step in enumerate(plan.steps):
        if isinstance(step.layer, Conv):
            yield index, _build_kernel(plan, index, step, step.layer)


def _build_kernel(plan: BufferPlan, index: int, step: Step, conv: Conv) -> KernelCall:
    inputs, out = [plan.buffers[k] for k in step.sources], plan.buffers[index + 1]
    outs, width = conv.weight.shape[0], inputs[0].channels
    name, stride = C_TYPES[inputs[0].signed][0], conv.stride * width
    if conv.depthwise and slides_along_row(conv):
        name = f"depthwise_along_{name}"
        shape = f"/* channels */ {width}, /* dilation */ {conv.dilation}, "
        shape += f"/* pad */ {conv.pad_value}"
    elif conv.depthwise:
        name = f"depthwise_{name}"
        shape = f"/* across */ {conv.dilation * width}, /* step */ {stride}, /* channels */ {width}"
    else:
        name = (
            f"convolve{'_pool' if step.pooled else ''}_{join_suffixes([b.signed for b in inputs])}"
        )
        taps = count_pointers(conv)
        run = width if taps == conv.kernel**2 else width * conv.kernel
        shape = f"/* taps */ {taps}, /* run */ {run}, /* step */ {stride}, /* outs */ {outs}"
    adds = "/* adds */ 1, " if inputs[1:] else "0, 0, /* adds */ 0, "
    plain = conv.depthwise or step.pooled
    numbers = f"{'' if plain else adds}/* cols */ {out.cols}, {shape},\n        "
    numbers += f"/* range */ {C_RANGES[conv.signed]}, /* shift */ {conv.shift}"
    return KernelCall(name, bool(inputs[1:]), numbers)


def generate_convolution_row(desk: StepAddresses, index: int) -> str:
    """Generate the row pointers of a kernel and its call.

    A pooled step computes two rows at once and has twice as many pointers.
    """
    step, conv = desk.plan.steps[index], desk.plan.steps[index].layer
    assert isinstance(conv, Conv)
    source, taps = desk.plan.buffers[step.sources[0]], count_pointers(conv)
    count = count_input_rows(step)
    row = _input_row(step.stride, _pointer_row(step, conv, taps))
    padding = 0 if slides_along_row(conv) else conv.padding
    start = plus_text((source.gap - padding) * source.channels)
    spread = conv.dilation * source.channels
    column = f" + k % {conv.kernel} * {spread}" if taps > conv.kernel else ""
    pointer = "k" if count > 1 else "0"
    place = f"{desk.input_address(0, source, row, pointer)}{start}{column}"
    lines = [f"const uint8_t *const in[1] = {{{place}}};"]
    if count > 1:
        lines = [
            f"const uint8_t *in[{count}];",
            f"for (int k = 0; k < {count}; k++)",
            f"    in[k] = {place};",
        ]
    return indent_lines([*lines, *_generate_call(desk, index)])


def _generate_call(desk: StepAddresses, index: int) -> list[str]:
    plan, step, out = desk.plan, desk.plan.steps[index], desk.plan.buffers[index + 1]
    kernel = dict(_iter_convolutions(plan))[index]
    words = ["in", desk.output_address(out)]
    words += [desk.table_address(kind, f"{step.name}_{kind}") for kind in ("weights", "scales")]
    if kernel.shortcut:
        words.append(desk.values_address(1, plan.buffers[step.sources[1]]))
        words.append(desk.table_address("gains", f"{step.name}_gains"))
    call = f"convolution_{_unique_kernels(plan).index(kernel)}("
    return [
        call,
        *wrap_words([f"{w}," for w in words[:-1]] + [f"{words[-1]});"], "    "),
        *desk.copy_out(out),
    ]


def _input_row(factor: int, offset: str) -> str:
    """Return the input row of output row ``row`` as C text."""
    return (f"{factor} * row" if factor > 1 else "row") + offset


def _pointer_row(step: Step, conv: Conv, taps: int) -> str:
    """Return the input row of pointer ``k``, relative to the first row under the kernel."""
    terms = [f" - {conv.padding}"] if conv.padding else []
    within = f"k % {taps}" if step.pooled else "k"
    if taps > conv.kernel:
        terms.append(f" + {within} / {conv.kernel} * {conv.dilation}")
    elif conv.kernel > 1:
        terms.append(f" + {within}{_times_text(conv.dilation)}")
    if step.pooled:
        output = f"k / {taps}" if taps > 1 else "k"
        terms.append(f" + {output}{_times_text(conv.stride)}")
    return "".join(terms)


def _times_text(factor: int) -> str:
    return f" * {factor}" if factor > 1 else ""
