"""C of a network, run as a shared library (``--backend c``)."""

import ctypes
import platform
import shutil
import tempfile
import weakref
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c import c_name, write_c
from dmrl.deploy.c.harness import DETECTION_DTYPE, MAX_DETECTIONS, HarnessResult, to_detections
from dmrl.deploy.c.run.compile_targets import Build
from dmrl.deploy.c.run.toolchain import find_host_compiler
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import ModelError

LIBRARY_FLAGS = ("-O3", "-shared", "-fPIC", "-DHARNESS_SHARED")
# Rows are short: 512-bit vectors would spend their time on remainders.
X86_FLAGS = ("-march=native", "-mprefer-vector-width=256")


class CompiledNetwork:
    """A network, compiled for this machine. Not thread-safe: the C has one state.

    The library lies in a folder that is removed with this object.

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
        self.network = network
        place = Path(tempfile.mkdtemp(prefix="dmrl-c-"))
        self._remove = weakref.finalize(self, shutil.rmtree, place, ignore_errors=True)
        if folder is None:
            write_c(network, place, [])
        require_c_files(network, folder or place)
        own = X86_FLAGS if platform.machine() in ("x86_64", "AMD64") else ()
        build = Build("library", compiler or find_host_compiler(), (*LIBRARY_FLAGS, *own))
        (library,) = build.compile_program(network, folder or place, place)
        self._run = ctypes.CDLL(str(library)).harness_run

    def run_detections(self, image: NDArray[np.uint8], most: int = MAX_DETECTIONS) -> HarnessResult:
        """Return grids and detections of a (height, width, channels) image."""
        network = self.network
        assert image.shape == (network.height_px, network.width_px, network.channels)
        pixels = np.ascontiguousarray(image, np.uint8)
        grids = np.empty((len(network.heads), *network.grid_shape), np.int8)
        found = np.zeros(most, DETECTION_DTYPE)
        pointers = (ctypes.c_void_p(a.ctypes.data) for a in (pixels, grids, found))
        count = self._run(*pointers, most)
        named = dict(zip(network.heads, grids, strict=True))
        return HarnessResult(named, to_detections(found[:count]), 0)

    def run(self, image: NDArray[np.uint8]) -> dict[str, NDArray[np.int8]]:
        """Return every head's grid, as `run_network` of ``reference`` does."""
        return self.run_detections(image).grids


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
