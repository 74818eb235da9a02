"""The C of each step: its kernel, its function of one row, its constants."""

import re

import numpy as np

from dmrl.deploy.c.plan import Buffer, Plan, Step
from dmrl.deploy.c.text import array, fill
from dmrl.deploy.integer import Add, Conv, MaxPool
from dmrl.errors import ModelError

TYPES = {False: ("u8", "uint8_t"), True: ("s8", "int8_t")}
RANGES = {False: "0, 255", True: "-128, 127"}


def require_carried(plan: Plan) -> None:
    """Nothing, if the C has a kernel for every layer.

    Raises
    ------
    ModelError
        If not; the layer is named.
    """
    for step in plan.steps:
        if isinstance(step.layer, Conv) and step.layer.depthwise and step.layer.kernel != 3:
            raise ModelError(
                f"layer {step.layer.name} is a depthwise 1x1 convolution, which the C does not "
                "carry. Fold it into the convolution before it"
            )


def kernels(plan: Plan) -> str:
    """The kernels that the steps call, each once."""
    pools = any(s.pooled or isinstance(s.layer, MaxPool) for s in plan.steps)
    texts = [fill("largest.c")] if pools else []
    for step in plan.steps:
        signed = [plan.buffers[k].signed for k in step.sources]
        suffix, kind = TYPES[signed[0]]
        if isinstance(step.layer, Add):
            other, second = TYPES[signed[1]]
            names = {"suffix": f"{suffix}_{other}", "type": kind, "other": second}
            wanted = [fill("add.c", **names)]
        else:
            wanted = [fill(f, suffix=suffix, type=kind) for f in _templates(step)]
        texts += [text for text in wanted if text not in texts]
    return "".join(texts)


def _templates(step: Step) -> list[str]:
    if isinstance(step.layer, MaxPool):
        return ["pool.c"]
    assert isinstance(step.layer, Conv)
    if step.layer.depthwise:
        return ["depthwise.c"]
    return ["dense.c", "convolve_pool.c" if step.pooled else "convolve.c"]


def row_function(plan: Plan, index: int, prefix: str) -> str:
    """C function that makes one output row of a step."""
    step, out = plan.steps[index], plan.buffers[index + 1]
    inputs = [plan.buffers[k] for k in step.sources]
    if isinstance(step.layer, Conv):
        body = _conv_body(step, step.layer, inputs[0], out)
    elif isinstance(step.layer, Add):
        body = _add_body(step.layer, inputs, out)
    else:
        body = _pool_body(inputs[0], out)
    comment = f"/* {describe(plan, index)}. */\n"
    unused = "" if "row" in re.findall(r"\w+", body) else "    (void)row;\n"
    return (
        f"{comment}static void make_{step.name}({prefix}_t *net, int row)\n{{\n{unused}{body}}}\n\n"
    )


def describe(plan: Plan, index: int) -> str:
    """What a step does, in words."""
    step, out = plan.steps[index], plan.buffers[index + 1]
    source = plan.buffers[step.sources[0]]
    size = f"{source.cols} x {source.rows} x {source.channels}"
    after = f"{out.cols} x {out.rows} x {out.channels}"
    relu = "" if step.layer.signed else ", ReLU"
    if isinstance(step.layer, Add):
        names = " + ".join(plan.buffers[k].name for k in step.sources)
        return f"{step.name}: {names}{relu}, {after}"
    if isinstance(step.layer, MaxPool):
        return f"{step.name}: 2x2 max-pool, {size} -> {after}"
    assert isinstance(step.layer, Conv)
    conv = step.layer
    kind = f"{'depthwise ' if conv.depthwise else ''}{conv.kernel}x{conv.kernel} convolution"
    kind += f", stride {conv.stride}" if conv.stride > 1 else ""
    kind += f", dilation {conv.dilation}" if conv.dilation > 1 else ""
    return f"{step.name}: {kind}{relu}{', 2x2 max-pool' if step.pooled else ''}, {size} -> {after}"


def _target(out: Buffer) -> str:
    """Where an output row begins, behind its padding."""
    return f"{slot(out)}{_plus(out.gap * out.channels)}"


def slot(buffer: Buffer) -> str:
    """Where row ``row`` begins in a ring, its padding first."""
    if buffer.ring == 1:
        return f"net->{buffer.home}"
    place = "row" if buffer.ring >= buffer.rows else f"row % {buffer.ring}"
    return f"net->{buffer.home} + {place} * {buffer.row_bytes}"


def one_row(buffer: Buffer) -> bool:
    """Whether only the newest row is ever read."""
    return buffer.ring == 1 and not buffer.above


def _read(buffer: Buffer, row: str) -> str:
    """Where row ``row`` of a buffer, or of its padding, begins."""
    return slot(buffer) if one_row(buffer) else f"row_of_{buffer.name}(net, {row})"


def _plus(number: int) -> str:
    return f" + {number}" if number > 0 else f" - {-number}" if number < 0 else ""


def _row(factor: int, offset: str) -> str:
    """Input row of output row ``row``."""
    return (f"{factor} * row" if factor > 1 else "row") + offset


def _conv_body(step: Step, conv: Conv, source: Buffer, out: Buffer) -> str:
    """Pointers to what the kernel reads, then its call.

    A pointer leads to one row of the kernel, whose columns stand side by side in memory; with
    dilation they do not, and each weight of the kernel has a pointer of its own. A pooled step
    makes two rows at once and so has twice as many.
    """
    spread = conv.dilation > 1 and not conv.depthwise and conv.kernel > 1
    taps = conv.kernel**2 if spread else conv.kernel
    count = taps * (2 if step.pooled else 1)
    row = _row(step.stride, _row_of_pointer(step, conv, taps))
    start = _plus((source.gap - conv.padding) * source.channels)
    column = f" + k % {conv.kernel} * {conv.dilation * source.channels}" if spread else ""
    read = f"{_read(source, row)}{start}{column}"
    if count == 1:
        lines = [f"const uint8_t *const in[1] = {{{read}}};"]
    else:
        lines = [
            f"const uint8_t *in[{count}];",
            f"for (int k = 0; k < {count}; k++)",
            f"    in[k] = {read};",
        ]
    return _lines([*lines, *_conv_call(step, conv, source, out, taps)])


def _row_of_pointer(step: Step, conv: Conv, taps: int) -> str:
    """Input row of pointer ``k``, counted from the first row under the kernel."""
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


def _conv_call(step: Step, conv: Conv, source: Buffer, out: Buffer, taps: int) -> list[str]:
    suffix = TYPES[source.signed][0]
    outs, width = conv.weight.shape[0], source.channels
    constants = f"{step.name}_weights, {step.name}_scales"
    if conv.depthwise:
        name = f"depthwise_{suffix}"
        shape = f"{out.cols}, /* across */ {conv.dilation * width}, "
        shape += f"/* step */ {conv.stride * width}, /* channels */ {width}"
    else:
        name = f"convolve{'_pool' if step.pooled else ''}_{suffix}"
        run = width if taps == conv.kernel**2 else width * conv.kernel
        shape = f"{out.cols}, /* taps */ {taps}, /* run */ {run}, "
        shape += f"/* step */ {conv.stride * width}, /* outs */ {outs}"
    indent = " " * (len(name) + 1)
    return [
        f"{name}(in, {_target(out)}, {constants},",
        f"{indent}/* cols */ {shape},",
        f"{indent}/* range */ {RANGES[conv.signed]}, /* wide */ {int(conv.shift.min() < 33)});",
    ]


def _add_body(layer: Add, inputs: list[Buffer], out: Buffer) -> str:
    rows = [f"{_read(b, 'row')}{_plus(b.gap * b.channels)}" for b in inputs]
    name = "add_" + "_".join(TYPES[b.signed][0] for b in inputs)
    first, second = layer.multipliers
    return _lines(
        [
            f"const uint8_t *const in[2] = {{{rows[0]}, {rows[1]}}};",
            f"{name}(in, {_target(out)}, /* values */ {out.cols * out.channels},",
            f"{' ' * (len(name) + 1)}{first}, {second}, /* shift */ {layer.shift}, "
            f"/* range */ {RANGES[layer.signed]});",
        ]
    )


def _pool_body(source: Buffer, out: Buffer) -> str:
    start = _plus(source.gap * source.channels)
    rows = [f"{_read(source, f'2 * row{k}')}{start}" for k in ("", " + 1")]
    return _lines(
        [
            f"const uint8_t *const in[2] = {{{rows[0]}, {rows[1]}}};",
            f"pool_{TYPES[source.signed][0]}(in, {_target(out)}, /* cols */ {out.cols}, "
            f"/* channels */ {out.channels});",
        ]
    )


def _lines(lines: list[str]) -> str:
    return "".join(f"    {line}\n" for line in lines)


def constants(plan: Plan) -> tuple[str, int]:
    """Definitions of every step's weights and scales, and their size in bytes."""
    texts, size = [], 0
    for step in plan.steps:
        if isinstance(step.layer, Conv):
            conv = step.layer
            order = (0, 2, 3, 1)
            texts.append(array("int8_t", f"{step.name}_weights", conv.weight.transpose(order)))
            rows = zip(conv.bias, conv.multiplier, conv.shift, strict=True)
            scales = "".join(f"    {{{b}, {m}, {s}}},\n" for b, m, s in rows)
            name = f"{step.name}_scales[{conv.bias.size}]"
            texts.append(f"static const scale_t {name} = {{\n{scales}}};\n")
            size += conv.weight.size + 12 * conv.bias.size
    return "\n".join(texts), size


def declarations(plan: Plan) -> str:
    """Declarations of the weights and scales, which are defined at the end of the file."""
    lines = []
    for step in plan.steps:
        if isinstance(step.layer, Conv):
            lines.append(f"static const int8_t {step.name}_weights[{step.layer.weight.size}];\n")
            lines.append(f"static const scale_t {step.name}_scales[{step.layer.bias.size}];\n")
    return "".join(lines)


def longest_zero_row(plan: Plan) -> int:
    """Bytes of the longest row of padding that holds zeros; 0: there is none."""
    rows = [b.row_bytes + b.gap * b.channels for b in plan.buffers if b.above and b.pad_value == 0]
    return int(np.max(rows, initial=0))
