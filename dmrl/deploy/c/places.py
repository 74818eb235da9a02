"""Where rows lie, as C text, and what kernels are called by the types of what they read."""

from dmrl.deploy.c.plan import Buffer

TYPES = {False: ("u8", "uint8_t"), True: ("s8", "int8_t")}
RANGES = {False: "0, 255", True: "-128, 127"}


def suffixes(signed: list[bool]) -> str:
    """What tells kernels that read several tensors apart."""
    return "_".join(TYPES[each][0] for each in signed)


def target(out: Buffer) -> str:
    """Where an output row begins, behind its padding."""
    return f"{slot(out)}{plus(out.gap * out.channels)}"


def slot(buffer: Buffer) -> str:
    """Where row ``row`` begins in a ring, its padding first."""
    if buffer.ring == 1:
        return f"net->{buffer.home}"
    place = f"row % {buffer.ring}"
    if buffer.shift:
        place = f"(row + {buffer.shift}) % {buffer.ring}"
    elif buffer.ring >= buffer.rows:
        place = "row"
    return f"net->{buffer.home} + {place} * {buffer.row_bytes}"


def one_row(buffer: Buffer) -> bool:
    """Whether only the newest row is ever read."""
    return buffer.ring == 1 and not buffer.above


def read(buffer: Buffer, row: str) -> str:
    """Where row ``row`` of a buffer, or of its padding, begins."""
    return slot(buffer) if one_row(buffer) else f"row_of_{buffer.name}(net, {row})"


def values(buffer: Buffer) -> str:
    """Where row ``row`` of a buffer begins, behind its padding."""
    return f"{read(buffer, 'row')}{plus(buffer.gap * buffer.channels)}"


def plus(number: int) -> str:
    """A constant that is added; nothing where it is 0."""
    return f" + {number}" if number > 0 else f" - {-number}" if number < 0 else ""


def body(lines: list[str]) -> str:
    """Lines of a function."""
    return "".join(f"    {line}\n" for line in lines)
