"""Run a command and check that it ends without a bug."""

import io
from collections.abc import Callable
from contextlib import nullcontext, redirect_stderr, redirect_stdout

from dmrl.boundary import run_to_status


def run_to_end(work: Callable[[], object], *, mute: bool = False) -> tuple[int, str]:
    """Run a command; return its exit status and its error line, or an empty text.

    Assert that it prints no traceback, and exactly one line of error if the status is not 0.

    Parameters
    ----------
    work
        The command.
    mute
        Whether standard output is closed or full, and so must not be replaced.
    """
    said = io.StringIO()
    with redirect_stderr(said), nullcontext() if mute else redirect_stdout(io.StringIO()):
        status = run_to_status(work)
    errors = [line for line in said.getvalue().splitlines() if line.startswith("dmrl: ")]
    text = errors[-1] if errors else ""
    assert "Traceback" not in said.getvalue(), said.getvalue()
    assert "internal error" not in text, text
    assert len(errors) == (1 if status else 0), said.getvalue()
    return status, text
