"""Members of the state struct, as C text."""

from dmrl.deploy.c.buffer_plan import Buffer, BufferPlan


def generate_members(planned: BufferPlan, prefix: str) -> str:
    """Generate the members of the (near) state; ``prefix`` is that of macros."""
    stage = [
        f"    int32_t stage[{planned.l1_scratch_bytes // 4}]; /* tables and far rows of the "
        "current layer */"
    ]
    lines = stage if planned.l1_scratch_bytes else []
    lines += [
        f"    int16_t done[{len(planned.buffers)}]; /* rows of each tensor computed so far */"
    ]
    lines += [
        f"#if {prefix}_BAYER",
        "    int16_t raw_rows;",
        f"    uint8_t raw[3][{prefix}_WIDTH];",
        "#endif",
    ]
    lines.append(generate_rings(planned, in_l2=False).rstrip("\n"))
    if planned.zero_bytes and planned.l1_scratch_bytes:
        lines.append(f"    uint8_t zeros[{planned.zero_bytes}]; /* padding above and below */")
    if planned.pad_bytes:
        lines.append(f"    uint8_t image_pad[{planned.pad_bytes}];")
    return "\n".join(lines) + "\n"


def generate_rings(planned: BufferPlan, *, in_l2: bool) -> str:
    """Generate the ring members of the near or of the far state."""
    lines = []
    for name, size in planned.member_bytes(in_l2=in_l2).items():
        held = [b for b in planned.buffers if b.home == name]
        text = _describe_buffer(held[0])
        if len(held) > 1 and held[0].ring > 1:
            text = f"{held[0].ring} rows of {len(held)} layers, sharing one ring"
        elif len(held) > 1:
            text = f"rows of {len(held)} layers, each read immediately by the next"
        lines.append(f"    uint8_t {name}[{size}]; /* {text} */")
    return "".join(f"{line}\n" for line in lines)


def _describe_buffer(buffer: Buffer) -> str:
    rows = f"{buffer.ring} of {buffer.rows} rows" if buffer.ring < buffer.rows else "whole"
    padding = f" and {buffer.gap} of padding" if buffer.gap else ""
    kind = "int8" if buffer.signed else "uint8"
    return f"{rows}: {buffer.cols} pixels{padding} x {buffer.channels} {kind}"
