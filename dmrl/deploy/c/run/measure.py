"""Cost of the C on a 32-bit RISC-V: bytes, instructions, and an estimated frame rate."""

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c import MAX_L1_STATE_BYTES, c_name
from dmrl.deploy.c.run.compile_targets import RISCV_FLAGS, Build
from dmrl.deploy.c.run.toolchain import (
    EMULATOR,
    RISCV,
    find_host_compiler,
    find_missing,
    get_emulator_version,
    run_program,
    run_with_stderr,
)
from dmrl.deploy.c.templating import fill_template
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import ModelError, ToolError

CLUSTER_HZ = 175e6
"""Clock of the GAP8's cluster of eight cores, Hz."""
KERNEL_MACS_PER_CYCLE = 4.1
"""Multiply-accumulates per cycle of hand-written 8-bit kernels on eight cores, over a whole network
of this size. PULP-NN reaches 15.5 in one large layer."""


@dataclass(frozen=True, slots=True)
class ExecutionCost:
    """Cost on rv32imc at -O3. None: not measured.

    Parameters
    ----------
    code_bytes, constant_bytes
        Bytes of the object file.
    instructions
        Instructions executed per image.
    """

    code_bytes: int | None = None
    constant_bytes: int | None = None
    instructions: int | None = None


def measure_cost(network: IntegerNetwork, folder: Path, image: NDArray[np.uint8]) -> ExecutionCost:
    """Measure the cost of the C of an export folder; nothing without the cross compiler.

    Raises
    ------
    ToolError
        If compilation or the emulator fails.
    """
    if find_missing(RISCV):
        return ExecutionCost()
    with tempfile.TemporaryDirectory(prefix="dmrl-verify-") as place:
        code, constants = _measure_object(network, folder, Path(place))
        counted = None
        if not find_missing(EMULATOR):
            counted = _count_instructions(network, folder, Path(place), image)
    return ExecutionCost(code, constants, counted)


@dataclass(frozen=True, slots=True)
class StateMemory:
    """Memory that the C of an export keeps between rows.

    Parameters
    ----------
    state_bytes
        Bytes of RAM, of the near one if there are two memories.
    far_bytes
        Bytes of the far memory; 0: none.
    traffic_bytes
        Bytes copied between the two per image.
    """

    state_bytes: int
    far_bytes: int = 0
    traffic_bytes: int = 0

    @property
    def fits_l1(self) -> bool:
        """Whether the state fits a GAP8's L1 beside the stacks of the cores."""
        return self.state_bytes <= MAX_L1_STATE_BYTES


def parse_state_memory(network: IntegerNetwork, folder: Path) -> StateMemory:
    """Read the sizes from the header of an export folder; the C checks them at compile time.

    Raises
    ------
    ModelError
        If the header has none.
    """
    header = folder / f"{c_name(network)}.h"
    text = header.read_text(encoding="utf-8", errors="replace")
    names = ("STATE", "FAR", "TRAFFIC")
    found = [re.search(rf"_{name}_BYTES \((\d+)", text) for name in names]
    if not found[0]:
        raise ModelError(f"{header} is damaged. Export the model again: dmrl export")
    return StateMemory(*(int(one[1]) if one else 0 for one in found))


def _measure_object(network: IntegerNetwork, folder: Path, build: Path) -> tuple[int, int]:
    """Compile the object; return its bytes of code and of constants."""
    name = c_name(network)
    target = build / f"{name}.o"
    flags = ("-std=c99", "-O3", *RISCV_FLAGS, f"-D{name.upper()}_BAYER=0")
    run_program((RISCV, *flags, "-c", folder / f"{name}.c", "-o", target), "measuring the C")
    said = run_program((RISCV.replace("gcc", "size"), "-A", target), "measuring the C").decode()
    sections = re.findall(r"^(\.\S+)\s+(\d+)", said, flags=re.MULTILINE)
    code = sum(int(size) for name, size in sections if name.startswith(".text"))
    constants = sum(int(size) for name, size in sections if "rodata" in name)
    return code, constants


def _count_instructions(
    network: IntegerNetwork, folder: Path, build: Path, image: NDArray[np.uint8]
) -> int | None:
    """Count the instructions per image: the difference between two images and one."""
    plugin, source = build / "count.so", build / "count.c"
    source.write_text(fill_template("count.c"), encoding="utf-8")
    # QEMU 9 no longer accepts version 1 of the plugin interface.
    version = 1 if get_emulator_version() < 9 else 2
    flags = ("-O2", "-shared", "-fPIC", f"-DPLUGIN_VERSION={version}")
    harness = ("-O3", *RISCV_FLAGS, "-DHARNESS_COUNT")
    program = Build("-O3", RISCV, harness, emulated=True).compile_program(network, folder, build)
    counts = []
    try:
        run_program((find_host_compiler(), *flags, source, "-o", plugin), "counting instructions")
        for times in (1, 2):
            command = (EMULATOR, "-plugin", plugin, *program[1:])
            _, said = run_with_stderr(
                command, "counting instructions", data=image.tobytes() * times
            )
            found = re.search(r"executed (\d+)", said)
            if not found:
                return None
            counts.append(int(found[1]))
    except ToolError:
        return None  # an emulator built without plugins
    return counts[1] - counts[0]


def estimate_rates(
    network: IntegerNetwork, found: ExecutionCost, kept: StateMemory
) -> list[tuple[float, str]]:
    """Estimate images per second on a GAP8; each estimate comes with its assumptions.

    Parameters
    ----------
    network
        The network.
    found
        Its cost, if measured.
    kept
        Its memory.
    """
    out = []
    memory = "no waiting for memory"
    if not kept.fits_l1:
        what = f"{kept.state_bytes:,} bytes of state"
        memory = f"without the waits for L2, where {what} lie that do not fit L1"
    elif kept.far_bytes:
        memory = (
            f"no waiting for the {kept.traffic_bytes:,} bytes that are copied from L2 and to it"
        )
    clock = f"{CLUSTER_HZ / 1e6:.0f} MHz"
    if found.instructions:
        words = (
            f"this C on one of the cluster's 8 cores at {clock}, one rv32imc instruction a cycle"
        )
        out.append((CLUSTER_HZ / found.instructions, f"{words}, {memory}"))
    words = (
        f"hand-written 8-bit SIMD kernels (not exported) on all 8 cores at {clock}, "
        f"{KERNEL_MACS_PER_CYCLE} multiply-accumulates a cycle"
    )
    out.append((CLUSTER_HZ * KERNEL_MACS_PER_CYCLE / network.macs, f"{words}, {memory}"))
    return out
