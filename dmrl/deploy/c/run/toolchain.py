"""Compilers and the emulator: found on the machine, run, their failures made readable."""

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dmrl.errors import ToolError

RISCV = "riscv64-unknown-elf-gcc"
EMULATOR = "qemu-riscv32"
HOST_COMPILERS = ("clang", "cc", "gcc")
"""In the order of how fast the C is that they make."""
PACKAGES = {
    "gcc": "gcc",
    "clang": "clang",
    RISCV: "gcc-riscv64-unknown-elf",
    EMULATOR: "qemu-user",
}
"""Debian packages of the programs that are looked for."""
LONGEST_S = 3600.0


def missing(*programs: str) -> str:
    """Which of these programs is absent, and how to get it; empty: none is."""
    absent = [p for p in programs if shutil.which(p) is None]
    return f"no {absent[0]}. Try: apt-get install {PACKAGES[absent[0]]}" if absent else ""


def host_compiler() -> str:
    """A C compiler for this machine.

    Raises
    ------
    ToolError
        If there is none.
    """
    for name in HOST_COMPILERS:
        if shutil.which(name):
            return name
    raise ToolError("no C compiler (clang, cc, gcc). Try: apt-get install gcc")


def run(command: Sequence[str | Path], what: str, *, data: bytes = b"") -> bytes:
    """Standard output of a program that ends well.

    Parameters
    ----------
    command
        The program and its arguments.
    what
        What it does, for the error.
    data
        Its standard input.

    Raises
    ------
    ToolError
        If it cannot be started, fails, or takes more than an hour.
    """
    return run_both(command, what, data=data)[0]


def run_both(command: Sequence[str | Path], what: str, *, data: bytes = b"") -> tuple[bytes, str]:
    """Standard output and standard error of a program that ends well; see ``run``."""
    try:
        done = subprocess.run(
            [str(word) for word in command],
            input=data,
            capture_output=True,
            timeout=LONGEST_S,
            check=False,
        )
    except OSError as e:
        raise ToolError(f"{what}: cannot run {command[0]}: {e.strerror}. Install it") from None
    except subprocess.TimeoutExpired:
        raise ToolError(f"{what}: {command[0]} took over an hour. Try fewer images") from None
    errors = done.stderr.decode(errors="replace")
    if done.returncode:
        raise ToolError(f"{what}: {command[0]} failed: {_telling(errors, done.returncode)}")
    return done.stdout, errors


def _telling(errors: str, status: int) -> str:
    """The line of a program's errors that says most."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    telling = [line for line in lines if re.search(r"error|ERROR|undefined", line)]
    return (telling or lines or [f"exit status {status}"])[0]


def emulator_version() -> int:
    """Major version of the emulator.

    Raises
    ------
    ToolError
        If it does not say one.
    """
    said = run((EMULATOR, "--version"), "the emulator's version").decode(errors="replace")
    found = re.search(r"version (\d+)", said)
    if not found:
        raise ToolError(f"{EMULATOR} --version says no version. Try: apt-get install qemu-user")
    return int(found[1])
