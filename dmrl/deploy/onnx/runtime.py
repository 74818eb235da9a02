"""Inference with onnxruntime, the fastest backend on a computer; no other module imports it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from dmrl.deploy.backends import Images, Outputs
from dmrl.deploy.int8.graph import rgb_to_grey
from dmrl.errors import MissingExtra, ModelError
from dmrl.guards import limits
from dmrl.guards.memory import MemoryLimit

try:
    import onnxruntime
except ImportError as e:
    raise MissingExtra("onnxruntime", "deploy", "running ONNX") from e

CHANNEL_OF_OUTPUT = {"confidence_logit": "confidence"}
"""Channel of an ONNX output, if it differs from the output's name."""


class OnnxRun:
    """Backend for an ONNX file written by dmrl, float or int8.

    Parameters
    ----------
    model
        The file, or its bytes.
    where
        Its name in errors.
    threads
        Threads of onnxruntime; 0: OMP_NUM_THREADS or, if that is not set, one per core.

    Raises
    ------
    ModelError
        If it cannot be run, or was not written by dmrl.
    """

    def __init__(self, model: Path | bytes, where: object = "the model", threads: int = 0) -> None:
        self._where = where
        self._size = len(model) if isinstance(model, bytes) else model.stat().st_size
        self._session = open_session(model, where, threads)
        inputs = self._session.get_inputs()
        self.names = [output.name for output in self._session.get_outputs()]
        if [i.name for i in inputs] != ["image"] or "confidence_logit" not in self.names:
            raise ModelError(
                f"{where} is not a network of dmrl export. Use an ONNX file that it wrote"
            )
        self.height_px, self.width_px, self.channels = (int(side) for side in inputs[0].shape[1:])

    def outputs(self, images: Images) -> Outputs:
        """Compute the output for (N, height, width, 3) RGB images."""
        # One by one: the layers of one image fit into the cache. A batch of 16 takes 1.3 times as
        # long per image and gives the same bits.
        ones = [image[None] for image in images] or [np.asarray(images)]
        seen = map(rgb_to_grey, ones) if self.channels == 1 else map(np.ascontiguousarray, ones)
        with _limit_memory(self._size, self._where):
            each = [self._session.run(self.names, {"image": image}) for image in seen]
        return {
            CHANNEL_OF_OUTPUT.get(name, name): np.concatenate(values)
            for name, values in zip(self.names, zip(*each, strict=True), strict=True)
        }


def open_session(
    model: Path | bytes, where: object, threads: int = 0
) -> "onnxruntime.InferenceSession":
    """Open an ONNX file, or the bytes of one that dmrl has just made; see `OnnxRun`.

    A file may be a stranger's and is checked first.

    Raises
    ------
    ModelError
        If it cannot be run.
    """
    options = onnxruntime.SessionOptions()
    # Other numeric libraries read OMP_NUM_THREADS; onnxruntime does not.
    given = os.environ.get("OMP_NUM_THREADS", "")
    options.intra_op_num_threads = threads or (int(given) if given.isdecimal() else 0)
    options.log_severity_level = 3
    if not _has_vnni():
        # Without VNNI, pairs of products are added in 16 bits, which overflow. This option
        # selects the slower exact kernels.
        options.add_session_config_entry("session.x64quantprecision", "1")
    if isinstance(model, bytes):
        data = model
    else:
        from dmrl.deploy.onnx.static_check import require_modest  # noqa: PLC0415 - loads onnx

        data = model.read_bytes()
        require_modest(data, where)
    with _limit_memory(len(data), where):
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


@contextmanager
def _limit_memory(size: int, where: object) -> Iterator[None]:
    """Limit the memory of onnxruntime in the block, and turn its errors into one line."""
    stacks = limits.MB * (os.cpu_count() or 1)  # each thread has a stack of 8 MB
    try:
        with MemoryLimit(size + stacks):
            yield
    except Exception as e:  # its exceptions have no common base
        why = " ".join(str(e).split())
        raise ModelError(f"{where} cannot be run: {why}. Export the model again") from None


def _has_vnni() -> bool:
    """Return whether the processor is known to multiply bytes without overflow."""
    try:
        return "vnni" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
