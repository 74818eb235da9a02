"""Assembly of the C file and its header."""

from dataclasses import dataclass, replace

from dmrl.deploy.c.buffer_plan import Buffer, BufferPlan, plan_buffers
from dmrl.deploy.c.convolutions import generate_shared_kernels
from dmrl.deploy.c.layer_code import (
    generate_constants,
    generate_kernels,
    generate_row_function,
    require_supported,
)
from dmrl.deploy.c.memory_levels import assign_memories, count_copied_bytes
from dmrl.deploy.c.row_addresses import keeps_one_row, mark_unused, row_address, state_arguments
from dmrl.deploy.c.state_struct import generate_members, generate_rings
from dmrl.deploy.c.templating import fill_template, format_array
from dmrl.deploy.int8.layers import GAIN_SHIFT
from dmrl.deploy.int8.network import SUBPIXEL, Head, IntegerNetwork
from dmrl.learn.inference.decode_grids import DUPLICATE_RADIUS_PX

MAX_STACK_BYTES = 640
"""Maximum stack of the C on a 32-bit core, optimised; `dmrl verify` measures it."""


@dataclass(frozen=True, slots=True)
class CSource:
    """Generated C of a network.

    Parameters
    ----------
    code, header
        Text of the two files.
    state_bytes, bayer_bytes
        Bytes of the (near) state, and bytes that raw Bayer images add.
    far_bytes, traffic_bytes
        Bytes of the far state, and bytes copied to and from it per image; 0: none.
    constant_bytes
        Bytes of weights and tables.
    stack_bytes
        Maximum stack; see ``MAX_STACK_BYTES``.
    """

    code: str
    header: str
    state_bytes: int
    bayer_bytes: int
    far_bytes: int
    traffic_bytes: int
    constant_bytes: int
    stack_bytes: int = MAX_STACK_BYTES


def generate_source(
    network: IntegerNetwork,
    names: dict[str, str],
    *,
    bayer: bool,
    near_bytes: int | None = None,
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
        Bytes of the near memory; rings that do not fit are placed in a far one, see
        `memory_levels`. None: one memory.

    Raises
    ------
    ModelError
        If the C does not support the network; the message contains the layer's name.
    SettingError
        If the near memory is too small.
    """
    planned = plan_buffers(network)
    require_supported(planned)
    if near_bytes is not None:
        planned = assign_memories(planned, near_bytes)
    names = {**names, **state_arguments(planned, names["prefix"])}
    weights, weight_bytes = generate_constants(planned)
    tables = {f"{name}_table": head for name, head in network.heads.items()}
    done = CSource(
        code=_generate_code(planned, names, weights, tables),
        header="",
        state_bytes=planned.state_bytes(bayer=False),
        bayer_bytes=planned.state_bytes(bayer=True) - planned.state_bytes(bayer=False),
        far_bytes=sum(planned.member_bytes(in_l2=True).values()),
        traffic_bytes=count_copied_bytes(planned),
        constant_bytes=weight_bytes
        + 512 * len(tables)
        + (0 if planned.l1_scratch_bytes else planned.zero_bytes),
    )
    return replace(done, header=_generate_header(planned, names, done, bayer=bayer))


def _generate_code(
    planned: BufferPlan, names: dict[str, str], weights: str, tables: dict[str, Head]
) -> str:
    image, steps, prefix = planned.buffers[0], planned.steps, names["prefix"]
    parts = [fill_template("prelude.c", **names, gain_shift=GAIN_SHIFT)]
    # Before the code that uses them: C++ has no declaration of a constant without its value.
    parts.append(
        "/* Weights: of each output channel the kernel's rows, of each row the pixels, of "
        "each pixel\n * the channels; depthwise: pixels, then channels. */\n" + weights
    )
    parts += [
        "\n" + format_array(_table_type(name), name, head.table) for name, head in tables.items()
    ]
    parts += ["\n", generate_kernels(planned), generate_shared_kernels(planned)]
    if planned.zero_bytes and not planned.l1_scratch_bytes:
        parts.append(
            f"\nstatic const uint8_t zeros[{planned.zero_bytes}] = {{0}}; "
            "/* padding above and below */\n"
        )
    parts.append("\n" + (fill_template("stage.c", **names) if planned.l1_scratch_bytes else ""))
    read = {k for step in steps for k in step.sources}
    several = [b for k in sorted(read) if not keeps_one_row(b := planned.buffers[k])]
    parts += [_generate_row_access(planned, b, names) for b in several]
    parts += [generate_row_function(planned, k, prefix) for k in range(len(steps))]
    parts.append(_generate_schedule(planned, names))
    mosaic = fill_template("bayer.c", **names, store=_generate_pixel_store(image.channels))
    place = (
        row_address(image).replace("row %", "net->done[0] %") + f" + {image.gap * image.channels}"
    )
    parts.append(fill_template("rows.c", **names, place=place, bayer=mosaic))
    parts.append(_generate_decode(planned, names))
    return "".join(parts)


def _table_type(name: str) -> str:
    return "int16_t" if name.startswith("offset") else "uint16_t"


def _generate_row_access(planned: BufferPlan, buffer: Buffer, names: dict[str, str]) -> str:
    """Generate the C function that returns a row of a buffer, or of its padding."""
    text = f"    return {row_address(buffer)};\n"
    if buffer.above:
        zeros = "net->zeros" if planned.l1_scratch_bytes else "zeros"
        pad = "net->image_pad" if buffer.pad_value else zeros
        text = f"    if (row < 0 || row >= {buffer.rows})\n        return {pad};\n{text}"
    unused = mark_unused(text, *names["args"].split(", "))
    return (
        f"static const uint8_t *row_of_{buffer.name}({names['reads']}, int row)\n"
        f"{{\n{unused}{text}}}\n\n"
    )


def _generate_schedule(planned: BufferPlan, names: dict[str, str]) -> str:
    table, cases = "", ""
    for k, step in enumerate(planned.steps):
        readers = [n for n, other in enumerate(planned.steps) if k + 1 in other.sources]
        numbers = (
            step.sources[0],
            step.sources[-1],
            max(readers, default=k),
            step.stride,
            step.last,
            planned.buffers[step.sources[0]].rows,
            planned.buffers[k + 1].rows,
        )
        table += f"    {{{', '.join(map(str, numbers))}}}, /* {step.name} */\n"
        cases += f"    case {k}: make_{step.name}({names['args']}, row); break;\n"
    return fill_template(
        "schedule.c",
        **names,
        count=len(planned.steps),
        table=table,
        cases=cases,
        pads=_generate_padding(planned, names),
    )


def _generate_padding(planned: BufferPlan, names: dict[str, str]) -> str:
    """Generate the C that fills padding, which no layer writes."""
    places = {
        f"{'away' if b.in_l2 else 'net'}->{b.home}": b.pad_value for b in planned.buffers if b.gap
    }
    if planned.pad_bytes:
        places["net->image_pad"] = planned.buffers[0].pad_value
    if planned.zero_bytes and planned.l1_scratch_bytes:
        places["net->zeros"] = 0
    text = "".join(f"    fill({at}, {value}, sizeof {at});\n" for at, value in places.items())
    return mark_unused("net" + text, *names["args"].split(", ")) + text


def _generate_pixel_store(channels: int) -> str:
    """Generate the C that stores one demosaiced pixel."""
    if channels == 1:
        grey = "(uint8_t)((77 * red + 150 * green + 29 * blue + 128) >> 8)"
        return f"        out[x] = {grey};\n"
    colours = ("red", "green", "blue")
    return "".join(f"        out[3 * x + {k}] = (uint8_t){c};\n" for k, c in enumerate(colours))


def _generate_cell_read(planned: BufferPlan, head: Head) -> str:
    """Generate the C that reads a head's value in a cell."""
    buffer = planned.buffers[planned.tensors[head.tensor]]
    place = f"row * {buffer.row_bytes} + col * {buffer.channels} + {head.channel}"
    return f"(int8_t)net->{buffer.home}[{place}]"


def _generate_decode(planned: BufferPlan, names: dict[str, str]) -> str:
    network, heads = planned.network, planned.network.heads
    cases = "".join(
        f"    case {_head_name(names, name)}: return {_generate_cell_read(planned, head)};\n"
        for name, head in heads.items()
    )
    meanings = "".join(
        f"    case {_head_name(names, name)}: return {name}_table[value + 128];\n" for name in heads
    )
    step, sub_cell = network.stride_px * SUBPIXEL, "offset_u" in heads
    places = {}
    for axis, side in (("u", "col"), ("v", "row")):
        value = f"{names['prefix']}_output(net, {_head_name(names, f'offset_{axis}')}, row, col)"
        offset = (
            f"offset_{axis}_table[{value} + 128]" if f"offset_{axis}" in heads else str(step // 2)
        )
        places[axis] = f"{side} * {step} + {offset}"
        if sub_cell:
            places[axis] = f"within({places[axis]}, {names['PREFIX']}_{side.upper()}S * {step})"
    near = int(DUPLICATE_RADIUS_PX * SUBPIXEL)
    doubles = fill_template("doubles.c", **names, near=near) if sub_cell else ""
    count = "without_doubles(found, count)" if sub_cell else "count"
    return fill_template(
        "decode.c",
        **names,
        **places,
        cases=cases,
        meanings=meanings,
        doubles=doubles,
        count=count,
    )


def _head_name(names: dict[str, str], head: str) -> str:
    """Return the enumerator of a head in the header."""
    return f"{names['PREFIX']}_{head.upper()}"


def _generate_header(
    planned: BufferPlan, names: dict[str, str], done: CSource, *, bayer: bool
) -> str:
    network = planned.network
    rows, cols = network.grid_shape
    return fill_template(
        "header.h",
        **names,
        stack_bytes=MAX_STACK_BYTES,
        constant_bytes=done.constant_bytes,
        macs=network.macs,
        width=network.width_px,
        height=network.height_px,
        channels=network.channels,
        rows=rows,
        cols=cols,
        stride=network.stride_px,
        bayer=int(bayer),
        threshold=f"{network.threshold:g}",
        threshold_step=network.threshold_q,
        state_bytes=done.state_bytes,
        bayer_bytes=done.bayer_bytes,
        heads=", ".join(_head_name(names, name) for name in network.heads),
        far=_generate_far_header(planned, names, done) if done.far_bytes else "",
        members=generate_members(planned, names["PREFIX"]),
    )


def _generate_far_header(planned: BufferPlan, names: dict[str, str], done: CSource) -> str:
    return fill_template(
        "far.h",
        **names,
        far_bytes=done.far_bytes,
        traffic_bytes=done.traffic_bytes,
        members=generate_rings(planned, in_l2=True),
    )
