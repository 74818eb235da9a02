"""C of each step: its kernel, its function of one row, and its constants."""

from dmrl.deploy.c.buffer_plan import BufferPlan
from dmrl.deploy.c.convolutions import generate_convolution_row, kernel_templates
from dmrl.deploy.c.memory_levels import list_staged_buffers
from dmrl.deploy.c.row_addresses import (
    C_RANGES,
    C_TYPES,
    StepAddresses,
    indent_lines,
    join_suffixes,
    mark_unused,
    plus_text,
    state_arguments,
)
from dmrl.deploy.c.row_schedule import Step
from dmrl.deploy.c.templating import fill_template, format_array
from dmrl.deploy.int8.network import Add, Conv, MaxPool
from dmrl.errors import ModelError


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


def generate_kernels(plan: BufferPlan) -> str:
    """Generate the kernels that the steps call, each once."""
    pools = any(s.pooled or isinstance(s.layer, MaxPool) for s in plan.steps)
    texts = [fill_template("largest.c")] if pools else []
    for step in plan.steps:
        signed = [plan.buffers[k].signed for k in step.sources]
        suffix, kind = C_TYPES[signed[0]]
        other = C_TYPES[signed[-1]][1]
        names = {"suffix": suffix, "type": kind, "suffixes": join_suffixes(signed), "other": other}
        wanted = [fill_template(f, **names) for f in _step_templates(step)]
        texts += [text for text in wanted if text not in texts]
    return "".join(texts)


def _step_templates(step: Step) -> list[str]:
    if isinstance(step.layer, Conv):
        return kernel_templates(step, step.layer)
    return ["pool.c" if isinstance(step.layer, MaxPool) else "add.c"]


def generate_row_function(plan: BufferPlan, index: int, prefix: str) -> str:
    """Generate the C function that computes one output row of a step."""
    step, desk = plan.steps[index], StepAddresses(plan, list_staged_buffers(plan, index))
    if isinstance(step.layer, Conv):
        text = generate_convolution_row(desk, index)
    else:
        text = (_generate_add if isinstance(step.layer, Add) else _generate_pool)(desk, index)
    names = state_arguments(plan, prefix)
    unused = mark_unused(text, *names["args"].split(", "), "row")
    return (
        f"/* {describe_step(plan, index)}. */\n"
        f"APART void make_{step.name}({names['params']}, int row)\n{{\n{unused}{text}}}\n\n"
    )


def describe_step(plan: BufferPlan, index: int) -> str:
    """Describe a step in words, for comments."""
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
    kind += f", + {plan.buffers[step.sources[1]].name}" if conv.shortcut >= 0 else ""
    return f"{step.name}: {kind}{relu}{', 2x2 max-pool' if step.pooled else ''}, {size} -> {after}"


def _generate_add(desk: StepAddresses, index: int) -> str:
    step, out = desk.plan.steps[index], desk.plan.buffers[index + 1]
    inputs, layer = [desk.plan.buffers[k] for k in step.sources], step.layer
    assert isinstance(layer, Add)
    rows = [desk.values_address(k, b) for k, b in enumerate(inputs)]
    name = f"add_{join_suffixes([b.signed for b in inputs])}"
    first, second = layer.multipliers
    return indent_lines(
        [
            f"const uint8_t *const in[2] = {{{rows[0]}, {rows[1]}}};",
            f"{name}(in, {desk.output_address(out)}, /* values */ {out.cols * out.channels},",
            f"{' ' * (len(name) + 1)}{first}, {second}, /* shift */ {layer.shift}, "
            f"/* range */ {C_RANGES[layer.signed]});",
            *desk.copy_out(out),
        ]
    )


def _generate_pool(desk: StepAddresses, index: int) -> str:
    source, out = (desk.plan.buffers[k] for k in (desk.plan.steps[index].sources[0], index + 1))
    start = plus_text(source.gap * source.channels)
    rows = [desk.input_address(0, source, f"2 * row + {k}", f"{k}") + start for k in range(2)]
    return indent_lines(
        [
            f"const uint8_t *const in[2] = {{{rows[0]}, {rows[1]}}};",
            f"pool_{C_TYPES[source.signed][0]}(in, {desk.output_address(out)}, /* cols */ "
            f"{out.cols}, "
            f"/* channels */ {out.channels});",
            *desk.copy_out(out),
        ]
    )


def generate_constants(plan: BufferPlan) -> tuple[str, int]:
    """Generate the weights and scales of every step; also return their size in bytes."""
    texts, size = [], 0
    for step in plan.steps:
        if isinstance(step.layer, Conv):
            conv = step.layer
            order = (0, 2, 3, 1)
            texts.append(
                format_array("int8_t", f"{step.name}_weights", conv.weight.transpose(order))
            )
            rows = zip(conv.bias, conv.multiplier, strict=True)
            scales = "".join(f"    {{{b}, {m}}},\n" for b, m in rows)
            name = f"{step.name}_scales[{conv.bias.size}]"
            texts.append(f"static const scale_t {name} = {{\n{scales}}};\n")
            size += conv.weight.size + 8 * conv.bias.size + 4 * conv.gain.size
            if conv.gain.size:
                texts.append(format_array("int32_t", f"{step.name}_gains", conv.gain))
    return "\n".join(texts), size
