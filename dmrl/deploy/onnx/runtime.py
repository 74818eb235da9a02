"""ONNX files through onnxruntime: the fast way on a computer. The home of onnxruntime."""

import os
from pathlib import Path

import numpy as np

from dmrl.deploy.backends import Images, Outputs
from dmrl.deploy.int8.graph import grey_of
from dmrl.errors import MissingExtra, ModelError

try:
    import onnxruntime
except ImportError as e:
    raise MissingExtra("onnxruntime", "deploy", "running ONNX") from e

CHANNEL_OF = {"confidence_logit": "confidence"}
"""Channel of an ONNX output, where it is not the output's own name."""


class OnnxRun:
    """A backend on an ONNX file that dmrl wrote, float or int8.

    Parameters
    ----------
    model
        The file, or its bytes.
    where
        Its name in errors.
    threads
        Of onnxruntime; 0: as many as there are cores.

    Raises
    ------
    ModelError
        If it cannot be run, or is not a network that dmrl wrote.
    """

    def __init__(self, model: Path | bytes, where: object = "the model", threads: int = 0) -> None:
        options = onnxruntime.SessionOptions()
        # As all numeric libraries do, but this one by itself not.
        given = os.environ.get("OMP_NUM_THREADS", "")
        options.intra_op_num_threads = threads or (int(given) if given.isdecimal() else 0)
        options.log_severity_level = 3
        if not _has_vnni():
            # Such processors add pairs of products in 16 bits, which overflow; the slower way
            # does not.
            options.add_session_config_entry("session.x64quantprecision", "1")
        source = model if isinstance(model, bytes) else str(model)
        try:
            self._session = onnxruntime.InferenceSession(
                source, options, providers=["CPUExecutionProvider"]
            )
        except Exception as e:  # its exceptions have no common base
            why = " ".join(str(e).split())
            raise ModelError(f"{where} cannot be run: {why}. Export the model again") from None
        inputs = self._session.get_inputs()
        self.names = [output.name for output in self._session.get_outputs()]
        if [i.name for i in inputs] != ["image"] or "confidence_logit" not in self.names:
            raise ModelError(f"{where} is not a network that dmrl export wrote. Give one")
        self.height_px, self.width_px, self.channels = (int(side) for side in inputs[0].shape[1:])

    def outputs(self, images: Images) -> Outputs:
        """Output for (N, height, width, 3) RGB images."""
        # One by one: the layers of one image fit a processor's cache, those of 16 take 1.3 times as
        # long, and the values are the same bits. So nothing has to be stacked either.
        ones = [image[None] for image in images] or [np.asarray(images)]
        seen = map(grey_of, ones) if self.channels == 1 else map(np.ascontiguousarray, ones)
        each = [self._session.run(self.names, {"image": image}) for image in seen]
        return {
            CHANNEL_OF.get(name, name): np.concatenate(values)
            for name, values in zip(self.names, zip(*each, strict=True), strict=True)
        }


def _has_vnni() -> bool:
    """Whether the processor is known to multiply bytes without overflow."""
    try:
        return "vnni" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
