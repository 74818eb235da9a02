"""The C of a network on a 32-bit RISC-V, in an emulator: ``predict --backend riscv32``."""

import shutil
import tempfile
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c import c_name, write_c
from dmrl.deploy.c.harness import answers
from dmrl.deploy.c.run.compile_targets import Build, Target, targets
from dmrl.deploy.c.run.compiled import require_c
from dmrl.deploy.c.run.toolchain import run
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import ToolError

RISCV32 = "riscv32"


class Emulated:
    """A network, compiled for rv32imc. An image takes seconds: the chip's words, not its speed.

    Parameters
    ----------
    network
        What the C computes.
    folder
        An export folder, whose C is used. None: the C is written anew.

    Raises
    ------
    ToolError
        If the compiler or the emulator is missing, or the C does not compile.
    ModelError
        If the folder has no C, or the C cannot carry the network.
    """

    def __init__(self, network: IntegerNetwork, folder: Path | None = None) -> None:
        target: Target = next(t for t in targets() if t.name == RISCV32)
        if target.skipped:
            raise ToolError(f"--backend {RISCV32}: {target.skipped}")
        self.network = network
        build = Path(tempfile.mkdtemp(prefix="dmrl-riscv-"))
        self._remove = weakref.finalize(self, shutil.rmtree, build, ignore_errors=True)
        if folder is None:
            write_c(network, build, [])
            folder = build
        require_c(network, folder)
        first: Build = target.builds[0]
        self._what = f"{c_name(network)}.c on {RISCV32}"
        self._program = first.program(network, folder, build)

    def run(self, image: NDArray[np.uint8]) -> dict[str, NDArray[np.int8]]:
        """Every head's grid, as ``reference.run`` gives it."""
        said = run(self._program, self._what, data=np.ascontiguousarray(image).tobytes())
        found = answers(self.network, said)
        if len(found) != 1:
            raise ToolError(f"{self._what}: {len(found)} answers to an image. Export it again")
        return found[0].grids
