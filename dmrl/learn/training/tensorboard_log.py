"""TensorBoard log of a training."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dmrl.guards.telemetry import hide_module

with hide_module("botocore"):  # TensorBoard imports it, if it is installed; it opens a socket
    from torch.utils.tensorboard import SummaryWriter

ScalarWriter = Callable[[str, float, int], None]
"""Function that logs the name of a curve, its value and the step."""


@contextmanager
def open_log(folder: Path, first_step: int) -> Iterator[ScalarWriter]:
    """Open a TensorBoard log in ``folder``; earlier values from ``first_step`` on are dropped.

    Raises
    ------
    OSError
        If the log cannot be written: raised by one of the next writes, or at the end.
    """
    before = threading.excepthook

    def hook(args: threading.ExceptHookArgs) -> None:
        # TensorBoard's writer thread fails first; the same error is then raised in this thread.
        if not type(args.thread).__module__.startswith("tensorboard."):
            before(args)

    threading.excepthook = hook
    try:
        with SummaryWriter(folder, purge_step=first_step) as writer:
            yield writer.add_scalar
    finally:
        threading.excepthook = before
