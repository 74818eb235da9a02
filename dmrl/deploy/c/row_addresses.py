"""Addresses of rows and tables as C text, and type suffixes of kernels."""

import re
from dataclasses import dataclass

from dmrl.deploy.c.buffer_plan import Buffer, BufferPlan
from dmrl.deploy.c.memory_levels import StagedBuffer

C_TYPES = {False: ("u8", "uint8_t"), True: ("s8", "int8_t")}
TABLE_TYPES = {"weights": "int8_t", "scales": "scale_t", "gains": "int32_t"}
C_RANGES = {False: "0, 255", True: "-128, 127"}


def state_arguments(plan: BufferPlan, prefix: str) -> dict[str, str]:
    """Return the state parameters and arguments of the generated functions.

    Returns
    -------
    dict
        ``params``; ``reads``, the same with const; ``args``; ``refs``, the arguments of a caller
        that owns the state.
    """
    kinds = {"net": f"{prefix}_t"} | ({"away": f"{prefix}_far_t"} if plan.l1_scratch_bytes else {})
    params = ", ".join(f"{kind} *{name}" for name, kind in kinds.items())
    return {
        "params": params,
        "reads": ", ".join(f"const {kind} *{name}" for name, kind in kinds.items()),
        "args": ", ".join(kinds),
        "refs": ", ".join(f"&{name}" for name in kinds),
    }


def join_suffixes(signed: list[bool]) -> str:
    """Return the type suffix of kernels that read several tensors."""
    return "_".join(C_TYPES[each][0] for each in signed)


def output_address(out: Buffer) -> str:
    """Return the address of an output row, behind its padding."""
    return f"{row_address(out)}{plus_text(out.gap * out.channels)}"


def row_address(buffer: Buffer) -> str:
    """Return the address of row ``row`` in a ring, including its padding."""
    home = f"{'away' if buffer.in_l2 else 'net'}->{buffer.home}"
    if buffer.ring == 1:
        return home
    place = f"row % {buffer.ring}"
    if buffer.shift:
        place = f"(row + {buffer.shift}) % {buffer.ring}"
    elif buffer.ring >= buffer.rows:
        place = "row"
    return f"{home} + {place} * {buffer.row_bytes}"


def keeps_one_row(buffer: Buffer) -> bool:
    """Return whether only the newest row is ever read."""
    return buffer.ring == 1 and not buffer.above


@dataclass(frozen=True, slots=True)
class StepAddresses:
    """Addresses of a step's rows, tables and output: in the scratch buffer, or in place.

    Parameters
    ----------
    plan
        The plan.
    staged
        Content of the scratch buffer for this step, by kind.
    """

    plan: BufferPlan
    staged: dict[str, StagedBuffer]

    def table_address(self, kind: str, name: str) -> str:
        """Return the address of a table of the step."""
        if kind not in self.staged:
            return name
        return f"(const {TABLE_TYPES[kind]} *){copy_in(self.staged[kind], name)}"

    def input_address(self, number: int, buffer: Buffer, row: str, pointer: str = "0") -> str:
        """Return the address of row ``row`` of an input, or of its padding.

        ``number`` selects the input. A row of a far ring is first copied to place ``pointer``.
        """
        args = state_arguments(self.plan, "")["args"]
        place = (
            row_address(buffer) if keeps_one_row(buffer) else f"row_of_{buffer.name}({args}, {row})"
        )
        if not buffer.in_l2:
            return place
        return f"(const uint8_t *){copy_in(self.staged[f'{number}'], place, pointer)}"

    def values_address(self, number: int, buffer: Buffer) -> str:
        """Return the address of row ``row`` of an input, behind its padding."""
        return (
            f"{self.input_address(number, buffer, 'row')}{plus_text(buffer.gap * buffer.channels)}"
        )

    def output_address(self, out: Buffer) -> str:
        """Return the address where the output row is computed."""
        return f"at_stage(net, {self.staged['out'].at})" if out.in_l2 else output_address(out)

    def copy_out(self, out: Buffer) -> list[str]:
        """Return the statements that copy a computed output row to a far ring."""
        if not out.in_l2:
            return []
        load = self.staged["out"]
        return [f"brought({output_address(out)}, at_stage(net, {load.at}), {load.size_bytes});"]


def copy_in(load: StagedBuffer, place: str, number: str = "0") -> str:
    """Return a C expression that copies an item to the scratch buffer and gives its address."""
    at = f"{load.at}" if number == "0" else f"{load.at} + {number} * {load.size_bytes}"
    return f"brought(at_stage(net, {at}), {place}, {load.size_bytes})"


def mark_unused(text: str, *names: str) -> str:
    """Return statements for those parameters that a function's text does not use."""
    return "".join(f"    (void){n};\n" for n in names if n not in re.findall(r"\w+", text))


def plus_text(number: int) -> str:
    """Return C text that adds a constant; empty for 0."""
    return f" + {number}" if number > 0 else f" - {-number}" if number < 0 else ""


def indent_lines(lines: list[str]) -> str:
    """Indent the lines of a function."""
    return "".join(f"    {line}\n" for line in lines)
