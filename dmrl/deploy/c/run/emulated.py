"""C of a network on a 32-bit RISC-V in an emulator, for ``predict --backend riscv32``."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c import c_name
from dmrl.deploy.c.harness import parse_results
from dmrl.deploy.c.run.compile_targets import list_targets
from dmrl.deploy.c.run.compiled import BuiltNetwork
from dmrl.deploy.c.run.toolchain import run_program
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import ToolError

RISCV32 = "riscv32"


class EmulatedNetwork(BuiltNetwork):
    """A network, compiled for rv32imc and emulated. An image takes seconds.

    Output is that of the chip; speed is not.

    Parameters
    ----------
    network
        Network of the C.
    folder
        Export folder with the C. None: the C is generated.

    Raises
    ------
    ToolError
        If the compiler or the emulator is missing, or compilation fails.
    ModelError
        If the folder has no C, or the C does not support the network.
    """

    def __init__(self, network: IntegerNetwork, folder: Path | None = None) -> None:
        target = next(t for t in list_targets() if t.name == RISCV32)
        if target.skipped:
            raise ToolError(f"--backend {RISCV32}: {target.skipped}")
        super().__init__(network, folder)
        self._what = f"{c_name(network)}.c on {RISCV32}"
        self._program = target.builds[0].compile_program(network, self.folder, self.build)

    def run(self, image: NDArray[np.uint8]) -> dict[str, NDArray[np.int8]]:
        """Return every head's grid, as `run_network` of ``reference`` does."""
        said = run_program(self._program, self._what, data=np.ascontiguousarray(image).tobytes())
        found = parse_results(self.network, said)
        if len(found) != 1:
            raise ToolError(f"{self._what}: {len(found)} results for one image. Export it again")
        return found[0].grids
