"""Compilers and emulator: found on the machine and run, with readable errors."""

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dmrl.errors import ToolError

RISCV = "riscv64-unknown-elf-gcc"
EMULATOR = "qemu-riscv32"
HOST_COMPILERS = ("clang", "cc", "gcc")
"""C compilers of this machine, in order of the speed of the compiled C."""
DEBIAN_PACKAGES = {
    "gcc": "gcc",
    "clang": "clang",
    RISCV: "gcc-riscv64-unknown-elf",
    EMULATOR: "qemu-user",
}
"""Debian packages of the programs."""
PROGRAM_TIMEOUT_S = 3600.0
"""Timeout of a program, seconds."""


def find_missing(*programs: str) -> str:
    """Return which of these programs is missing, and how to install it; empty: none."""
    absent = [p for p in programs if shutil.which(p) is None]
    return f"no {absent[0]}. Try: apt-get install {DEBIAN_PACKAGES[absent[0]]}" if absent else ""


def find_host_compiler() -> str:
    """Return a C compiler for this machine.

    Raises
    ------
    ToolError
        If there is none.
    """
    for name in HOST_COMPILERS:
        if shutil.which(name):
            return name
    raise ToolError("no C compiler (clang, cc, gcc). Try: apt-get install gcc")


def run_program(command: Sequence[str | Path], what: str, *, data: bytes = b"") -> bytes:
    """Run a program and return its standard output.

    Parameters
    ----------
    command
        Program and arguments.
    what
        Purpose, for the error.
    data
        Standard input.

    Raises
    ------
    ToolError
        If it cannot be started, fails, or takes more than an hour.
    """
    return run_with_stderr(command, what, data=data)[0]


def run_with_stderr(
    command: Sequence[str | Path], what: str, *, data: bytes = b""
) -> tuple[bytes, str]:
    """Run a program and return standard output and standard error; see `run_program`."""
    try:
        done = subprocess.run(
            [str(word) for word in command],
            input=data,
            capture_output=True,
            timeout=PROGRAM_TIMEOUT_S,
            check=False,
        )
    except OSError as e:
        raise ToolError(f"{what}: cannot run {command[0]}: {e.strerror}. Install it") from None
    except subprocess.TimeoutExpired:
        raise ToolError(f"{what}: {command[0]} took over an hour. Try fewer images") from None
    errors = done.stderr.decode(errors="replace")
    if done.returncode:
        raise ToolError(f"{what}: {command[0]} failed: {_error_line(errors, done.returncode)}")
    return done.stdout, errors


def _error_line(errors: str, status: int) -> str:
    """Return the most informative line of a program's errors."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    telling = [line for line in lines if re.search(r"error|ERROR|undefined", line)]
    return (telling or lines or [f"exit status {status}"])[0]


def get_emulator_version() -> int:
    """Return the major version of the emulator.

    Raises
    ------
    ToolError
        If it prints none.
    """
    said = run_program((EMULATOR, "--version"), "the emulator's version").decode(errors="replace")
    found = re.search(r"version (\d+)", said)
    if not found:
        raise ToolError(f"{EMULATOR} --version prints no version. Try: apt-get install qemu-user")
    return int(found[1])
