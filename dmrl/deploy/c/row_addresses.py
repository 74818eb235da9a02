"""Where rows lie, as C text, and what kernels are called by the types of what they read."""

import re
from dataclasses import dataclass

from dmrl.deploy.c.buffer_plan import Buffer, Plan
from dmrl.deploy.c.memory_levels import Load

TYPES = {False: ("u8", "uint8_t"), True: ("s8", "int8_t")}
RANGES = {False: "0, 255", True: "-128, 127"}


def state_names(plan: Plan, prefix: str) -> dict[str, str]:
    """Parameters and arguments that every function of the C has that sees rows of the network.

    Returns
    -------
    dict
        ``params``; ``reads``, the same without the right to write; ``args``; ``refs``, what a
        caller that holds the state gives.
    """
    kinds = {"net": f"{prefix}_t"} | ({"away": f"{prefix}_far_t"} if plan.stage else {})
    params = ", ".join(f"{kind} *{name}" for name, kind in kinds.items())
    return {
        "params": params,
        "reads": ", ".join(f"const {kind} *{name}" for name, kind in kinds.items()),
        "args": ", ".join(kinds),
        "refs": ", ".join(f"&{name}" for name in kinds),
    }


def suffixes(signed: list[bool]) -> str:
    """What tells kernels that read several tensors apart."""
    return "_".join(TYPES[each][0] for each in signed)


def target(out: Buffer) -> str:
    """Where an output row begins, behind its padding."""
    return f"{slot(out)}{plus(out.gap * out.channels)}"


def slot(buffer: Buffer) -> str:
    """Where row ``row`` begins in a ring, its padding first."""
    home = f"{'away' if buffer.far else 'net'}->{buffer.home}"
    if buffer.ring == 1:
        return home
    place = f"row % {buffer.ring}"
    if buffer.shift:
        place = f"(row + {buffer.shift}) % {buffer.ring}"
    elif buffer.ring >= buffer.rows:
        place = "row"
    return f"{home} + {place} * {buffer.row_bytes}"


def one_row(buffer: Buffer) -> bool:
    """Whether only the newest row is ever read."""
    return buffer.ring == 1 and not buffer.above


@dataclass(frozen=True, slots=True)
class Desk:
    """Where a step finds its rows and tables, and where it writes: in the stage, or where they are.

    Parameters
    ----------
    plan
        The plan.
    staged
        What of the step lies in the stage, by kind.
    """

    plan: Plan
    staged: dict[str, Load]

    def table(self, kind: str, name: str) -> str:
        """Where a table of the step begins."""
        return brought(self.staged[kind], name) if kind in self.staged else name

    def read(self, number: int, buffer: Buffer, row: str, pointer: str = "0") -> str:
        """Where row ``row`` of an input, or of its padding, begins; it is the step's so many-th."""
        args = state_names(self.plan, "")["args"]
        place = slot(buffer) if one_row(buffer) else f"row_of_{buffer.name}({args}, {row})"
        if not buffer.far:
            return place
        return f"(const uint8_t *){brought(self.staged[f'{number}'], place, pointer)}"

    def values(self, number: int, buffer: Buffer) -> str:
        """Where row ``row`` of an input begins, behind its padding."""
        return f"{self.read(number, buffer, 'row')}{plus(buffer.gap * buffer.channels)}"

    def target(self, out: Buffer) -> str:
        """Where the output row is made."""
        return f"at_stage(net, {self.staged['out'].at})" if out.far else target(out)

    def sent(self, out: Buffer) -> list[str]:
        """What follows when the output row is made."""
        if not out.far:
            return []
        load = self.staged["out"]
        return [f"brought({target(out)}, at_stage(net, {load.at}), {load.size_bytes});"]


def brought(load: Load, place: str, number: str = "0") -> str:
    """C that brings one of a kind into the stage, and gives its place there."""
    at = f"{load.at}" if number == "0" else f"{load.at} + {number} * {load.size_bytes}"
    return f"brought(at_stage(net, {at}), {place}, {load.size_bytes})"


def marked_unused(text: str, *names: str) -> str:
    """Statements for those parameters that a function's text does not name."""
    return "".join(f"    (void){n};\n" for n in names if n not in re.findall(r"\w+", text))


def plus(number: int) -> str:
    """A constant that is added; nothing where it is 0."""
    return f" + {number}" if number > 0 else f" - {-number}" if number < 0 else ""


def body(lines: list[str]) -> str:
    """Lines of a function."""
    return "".join(f"    {line}\n" for line in lines)
