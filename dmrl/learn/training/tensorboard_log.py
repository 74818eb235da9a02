"""TensorBoard's log of a training."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

Board = Callable[[str, float, int], None]
"""Takes a curve's name, its value and the step."""


@contextmanager
def opened(folder: Path, first_step: int) -> Iterator[Board]:
    """A log in ``folder``; what an earlier training wrote from ``first_step`` on is void.

    Raises
    ------
    OSError
        If it cannot be written: said by one of the next values, or at the end.
    """
    before = threading.excepthook

    def hook(args: threading.ExceptHookArgs) -> None:
        # TensorBoard writes in a thread of its own, and raises what that met here once more.
        if not type(args.thread).__module__.startswith("tensorboard."):
            before(args)

    threading.excepthook = hook
    try:
        with SummaryWriter(folder, purge_step=first_step) as writer:
            yield writer.add_scalar
    finally:
        threading.excepthook = before
