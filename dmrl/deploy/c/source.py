"""The C file and its header, put together."""

from dataclasses import dataclass, replace

from dmrl.deploy.c.convolutions import shared_kernels
from dmrl.deploy.c.layers import (
    constants,
    declarations,
    kernels,
    longest_zero_row,
    require_carried,
    row_function,
)
from dmrl.deploy.c.places import one_row, slot
from dmrl.deploy.c.plan import Buffer, Plan, plan
from dmrl.deploy.c.text import array, fill
from dmrl.deploy.integer import SUBPIXEL, Head, IntegerNetwork
from dmrl.deploy.integer_layers import GAIN_SHIFT
from dmrl.learn.decode import SAME_PX

STACK_BYTES = 640
"""Stack that the C may use on a 32-bit core, optimised; `dmrl verify` measures it."""


@dataclass(frozen=True, slots=True)
class Source:
    """The C of a network.

    Parameters
    ----------
    code, header
        Text of the two files.
    state_bytes, bayer_bytes
        Bytes of the state, and what raw Bayer images add to it.
    constant_bytes
        Bytes of weights and tables.
    stack_bytes
        Stack that it may use; see ``STACK_BYTES``.
    """

    code: str
    header: str
    state_bytes: int
    bayer_bytes: int
    constant_bytes: int
    stack_bytes: int = STACK_BYTES


def source(
    network: IntegerNetwork, names: dict[str, str], *, bayer: bool, features: bool = False
) -> Source:
    """The C file and the header of a network.

    Parameters
    ----------
    network
        What is computed.
    names
        As ``text.names_of`` gives them.
    bayer
        Whether images are raw colour mosaics unless the user's compiler flags say otherwise.
    features
        Whether the state holds all that the last layer reads, for `refinement`.

    Raises
    ------
    ModelError
        If the C does not carry the network; the layer is named.
    """
    planned = plan(network, features=features)
    require_carried(planned)
    weights, weight_bytes = constants(planned)
    tables = {f"{name}_table": head for name, head in network.heads.items()}
    zeros = longest_zero_row(planned)
    counters = 2 * len(planned.buffers)
    used = counters + sum(planned.homes.values()) + _pad_bytes(planned)
    done = Source(
        code=_code(planned, names, weights, tables, zeros),
        header="",
        state_bytes=_even(used),
        bayer_bytes=_even(used + 2 + 3 * network.width_px) - _even(used),
        constant_bytes=weight_bytes + 512 * len(tables) + zeros,
    )
    return replace(done, header=_header(planned, names, done, bayer=bayer))


def _even(size: int) -> int:
    return (size + 1) // 2 * 2


def _pad_bytes(planned: Plan) -> int:
    image = planned.buffers[0]
    return image.row_bytes + image.gap * image.channels if _has_pad(image) else 0


def _has_pad(image: Buffer) -> bool:
    """Whether the image needs a row of padding of its own."""
    return image.above and image.pad_value != 0


def _code(
    planned: Plan, names: dict[str, str], weights: str, tables: dict[str, Head], zeros: int
) -> str:
    image, steps, prefix = planned.buffers[0], planned.steps, names["prefix"]
    parts = [
        fill("prelude.c", **names, gain_shift=GAIN_SHIFT),
        kernels(planned),
        shared_kernels(planned),
    ]
    parts.append("/* Defined at the end of the file. */\n" + declarations(planned))
    parts += [f"static const {_table_type(n)} {n}[256];\n" for n in tables]
    if zeros:
        parts.append(
            f"\nstatic const uint8_t zeros[{zeros}] = {{0}}; /* padding above and below */\n"
        )
    parts.append("\n")
    read = {k for step in steps for k in step.sources}
    several = [b for k in sorted(read) if not one_row(b := planned.buffers[k])]
    parts += [_row_access(b, prefix) for b in several]
    parts += [row_function(planned, k, prefix) for k in range(len(steps))]
    parts.append(_schedule(planned, names))
    mosaic = fill("bayer.c", **names, store=_store(image.channels))
    place = slot(image).replace("row %", "net->done[0] %") + f" + {image.gap * image.channels}"
    parts.append(fill("rows.c", **names, place=place, bayer=mosaic))
    parts.append(_decode(planned, names))
    parts.append(
        "/* Weights: of each output channel the kernel's rows, of each row the pixels, of "
        "each pixel\n * the channels; depthwise: pixels, then channels. */\n" + weights
    )
    for name, head in tables.items():
        parts.append("\n" + array(_table_type(name), name, head.table))
    return "".join(parts)


def _table_type(name: str) -> str:
    return "int16_t" if name.startswith("offset") else "uint16_t"


def _row_access(buffer: Buffer, prefix: str) -> str:
    """C function that gives a row of a buffer, or of its padding."""
    outside = ""
    if buffer.above:
        pad = "net->image_pad" if _has_pad(buffer) else "zeros"
        outside = f"    if (row < 0 || row >= {buffer.rows})\n        return {pad};\n"
    return (
        f"static const uint8_t *row_of_{buffer.name}(const {prefix}_t *net, int row)\n"
        f"{{\n{outside}    return {slot(buffer)};\n}}\n\n"
    )


def _schedule(planned: Plan, names: dict[str, str]) -> str:
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
        cases += f"    case {k}: make_{step.name}(net, row); break;\n"
    image, pads = planned.buffers[0], ""
    padded = {b.home: b.pad_value for b in planned.buffers if b.gap}
    for home, value in padded.items():
        pads += f"    fill(net->{home}, {value}, sizeof net->{home});\n"
    if _has_pad(image):
        pads += f"    fill(net->image_pad, {image.pad_value}, sizeof net->image_pad);\n"
    return fill(
        "schedule.c", **names, count=len(planned.steps), table=table, cases=cases, pads=pads
    )


def _store(channels: int) -> str:
    """C that writes one pixel of the mosaic's colours."""
    if channels == 1:
        grey = "(uint8_t)((77 * red + 150 * green + 29 * blue + 128) >> 8)"
        return f"        out[x] = {grey};\n"
    colours = ("red", "green", "blue")
    return "".join(f"        out[3 * x + {k}] = (uint8_t){c};\n" for k, c in enumerate(colours))


def _cell(planned: Plan, head: Head) -> str:
    """C that reads a head's value in a cell."""
    buffer = planned.buffers[planned.tensors[head.tensor]]
    place = f"row * {buffer.row_bytes} + col * {buffer.channels} + {head.channel}"
    return f"(int8_t)net->{buffer.home}[{place}]"


def _decode(planned: Plan, names: dict[str, str]) -> str:
    network, heads = planned.network, planned.network.heads
    cases = "".join(
        f"    case {_head_name(names, name)}: return {_cell(planned, head)};\n"
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
    near = int(SAME_PX * SUBPIXEL)
    doubles = fill("doubles.c", **names, near=near) if sub_cell else ""
    count = "without_doubles(found, count)" if sub_cell else "count"
    return fill(
        "decode.c",
        **names,
        **places,
        cases=cases,
        meanings=meanings,
        doubles=doubles,
        count=count,
    )


def _head_name(names: dict[str, str], head: str) -> str:
    """Number of a head, as the header calls it."""
    return f"{names['PREFIX']}_{head.upper()}"


def _header(planned: Plan, names: dict[str, str], done: Source, *, bayer: bool) -> str:
    network = planned.network
    rows, cols = network.grid_shape
    return fill(
        "header.h",
        **names,
        stack_bytes=STACK_BYTES,
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
        plain_bytes=done.state_bytes,
        bayer_bytes=done.bayer_bytes,
        heads=", ".join(_head_name(names, name) for name in network.heads),
        members=_members(planned).replace("@", names["PREFIX"]),
    )


def _members(planned: Plan) -> str:
    lines = [f"    int16_t done[{len(planned.buffers)}]; /* rows of each tensor that are there */"]
    lines += ["#if @_BAYER", "    int16_t raw_rows;", "    uint8_t raw[3][@_WIDTH];", "#endif"]
    for name, size in planned.homes.items():
        held = [b for b in planned.buffers if b.home == name]
        text = _columns(held[0])
        if len(held) > 1 and held[0].ring > 1:
            text = f"{held[0].ring} rows of {len(held)} layers, which take turns"
        elif len(held) > 1:
            text = f"rows of {len(held)} layers, each read at once by the next"
        lines.append(f"    uint8_t {name}[{size}]; /* {text} */")
    if _has_pad(planned.buffers[0]):
        lines.append(f"    uint8_t image_pad[{_pad_bytes(planned)}];")
    return "\n".join(lines) + "\n"


def _columns(buffer: Buffer) -> str:
    rows = f"{buffer.ring} of {buffer.rows} rows" if buffer.ring < buffer.rows else "whole"
    padding = f" and {buffer.gap} of padding" if buffer.gap else ""
    kind = "int8" if buffer.signed else "uint8"
    return f"{rows}: {buffer.cols} pixels{padding} x {buffer.channels} {kind}"
