"""Run a library on untrusted input in a sandboxed child process.

The child has limits of memory and CPU time, and no network where the system allows that. It takes
bytes on standard input and writes bytes on standard output. However it ends, the command survives
and reports it in one line.
"""

import ctypes
import os
import subprocess
import sys
from contextlib import suppress
from importlib import import_module

from dmrl.errors import DmrlError, SettingError
from dmrl.guards import limits
from dmrl.guards.memory import MemoryLimit
from dmrl.guards.posix import resource

CPU_TIME_S = 300
"""CPU time of a child, seconds. A query of a thousand recordings takes 0.1 s."""
REFUSED = 3
"""Exit status of a child that prints an error of dmrl."""
CHILD_CODE = "from dmrl.guards.cage import main; main()"
CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000


def run_caged(function: str, request: bytes, what: str) -> bytes:
    """Call a function in a child process.

    Parameters
    ----------
    function
        ``module:name`` of a function from bytes to bytes.
    request
        Its argument.
    what
        Subject of the error.

    Raises
    ------
    SettingError
        If the function raises a DmrlError, or the child exceeds its limits.
    """
    command = [sys.executable, "-c", CHILD_CODE, function, str(limits.MEMORY_BYTES)]
    done = subprocess.run(command, input=request, capture_output=True, check=False)
    if done.returncode == REFUSED:
        raise SettingError(done.stdout.decode(errors="replace"))
    if done.returncode:
        raise SettingError(
            f"{what} needs more than {limits.MEMORY_BYTES // limits.MB} MB or {CPU_TIME_S} s of "
            "CPU time. Ask for less"
        )
    return done.stdout


def main() -> None:
    """Run the function that the command line names, within the limits that it gives."""
    module, _, name = sys.argv[1].partition(":")
    call = getattr(import_module(module), name)
    limits.MEMORY_BYTES = int(sys.argv[2])
    request = sys.stdin.buffer.read()
    _leave_network()
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_TIME_S, CPU_TIME_S + 5))
    try:
        with MemoryLimit(len(request)):
            result = call(request)
    except DmrlError as e:
        result, status = str(e).encode(), REFUSED
    except MemoryError:
        os._exit(1)
    else:
        status = 0
    sys.stdout.buffer.write(result)
    sys.stdout.flush()
    os._exit(status)  # threads of the library may still hold memory beyond the limit


def _leave_network() -> None:
    """Move the process to a network without interfaces, where Linux lets it."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).unshare(CLONE_NEWUSER | CLONE_NEWNET)
