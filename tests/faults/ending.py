"""Possible endings of a command."""

import io
from collections.abc import Callable
from contextlib import nullcontext, redirect_stderr, redirect_stdout

from dmrl.boundary import run_to_status


def ended(work: Callable[[], object], *, mute: bool = False) -> tuple[int, str]:
    """Exit status and last words of a command; never a bug, never more than one line of error.

    Parameters
    ----------
    work
        The command.
    mute
        Standard output stays as it is, which takes nothing.
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
