"""C of a network, run as a shared library (``--backend c``) or emulated (``riscv32``)."""

import ctypes
import platform
import shutil
import tempfile
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c import c_name, harness, write_c
from dmrl.deploy.c.run.compile_targets import Build, list_targets
from dmrl.deploy.c.run.toolchain import find_host_compiler, run_program
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import ModelError, ToolError

RISCV32 = "riscv32"
LIBRARY_FLAGS = ("-O3", "-shared", "-fPIC", "-DHARNESS_SHARED")
# Rows are short: 512-bit vectors would spend their time on remainders.
X86_FLAGS = ("-march=native", "-mprefer-vector-width=256")


class BuiltNetwork:
    """Folder of a compiled network, removed with this object.

    Parameters
    ----------
    network
        Network of the C.
    folder
        Export folder with the C. None: the C is generated.

    Raises
    ------
    ModelError
        If the folder has no C, or the C does not support the network.
    """

    def __init__(self, network: IntegerNetwork, folder: Path | None) -> None:
        self.network = network
        self.build = Path(tempfile.mkdtemp(prefix="dmrl-c-"))
        self._remove = weakref.finalize(self, shutil.rmtree, self.build, ignore_errors=True)
        self.folder = folder or self.build
        if folder is None:
            write_c(network, self.build, [])
        require_c_files(network, self.folder)


class CompiledNetwork(BuiltNetwork):
    """A network, compiled for this machine. Not thread-safe: the C has one state.

    Parameters
    ----------
    network
        Network of the C.
    folder
        Export folder with the C. None: the C is generated.
    compiler
        Compiler program. None: the first one found.

    Raises
    ------
    ToolError
        If there is no C compiler, or compilation fails.
    ModelError
        If the folder has no C, or the C does not support the network.
    """

    def __init__(
        self, network: IntegerNetwork, folder: Path | None = None, compiler: str | None = None
    ) -> None:
        super().__init__(network, folder)
        own = X86_FLAGS if platform.machine() in ("x86_64", "AMD64") else ()
        build = Build("library", compiler or find_host_compiler(), (*LIBRARY_FLAGS, *own))
        (library,) = build.compile_program(network, self.folder, self.build)
        self._run = ctypes.CDLL(str(library)).harness_run

    def run_detections(
        self, image: NDArray[np.uint8], most: int = harness.MAX_DETECTIONS
    ) -> harness.HarnessResult:
        """Return grids and detections of a (height, width, channels) image."""
        network = self.network
        assert image.shape == (network.height_px, network.width_px, network.channels)
        pixels = np.ascontiguousarray(image, np.uint8)
        grids = np.empty((len(network.heads), *network.grid_shape), np.int8)
        found = np.zeros(most, harness.DETECTION_DTYPE)
        pointers = (ctypes.c_void_p(a.ctypes.data) for a in (pixels, grids, found))
        count = self._run(*pointers, most)
        named = dict(zip(network.heads, grids, strict=True))
        return harness.HarnessResult(named, harness.to_detections(found[:count]), 0)

    def run(self, image: NDArray[np.uint8]) -> dict[str, NDArray[np.int8]]:
        """Return every head's grid, as `run_network` of ``reference`` does."""
        return self.run_detections(image).grids


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
        found = harness.parse_results(self.network, said)
        if len(found) != 1:
            raise ToolError(f"{self._what}: {len(found)} results for one image. Export it again")
        return found[0].grids


def require_c_files(network: IntegerNetwork, folder: Path) -> None:
    """Raise ModelError unless a folder contains the C of a network.

    Raises
    ------
    ModelError
        If a file is missing or empty.
    """
    for name in (f"{c_name(network)}.c", f"{c_name(network)}.h"):
        file = folder / name
        if not file.is_file() or not file.stat().st_size:
            raise ModelError(
                f"no {name} in {folder}; a float model has none. Export an int8 one: "
                "dmrl quantize, then dmrl export"
            )
