"""The pilot's C, compiled and run step by step on this machine or under qemu."""

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from dmrl.deploy.c.run.compile_targets import RISCV_FLAGS
from dmrl.deploy.c.run.toolchain import EMULATOR, RISCV, find_host_compiler, run_program

EXACT = ("-std=gnu99", "-ffp-contract=off")
"""Flags with which the commands equal those of the reference bit for bit."""
HARNESS = Path(__file__).with_name("pilot_harness.c")


class CompiledPilot:
    """The pilot's C as a process that returns a command for each step.

    Parameters
    ----------
    folder
        Folder with pilot.c and pilot.h, in which the program is built.
    distance_m
        Distance to keep, metres.
    emulated
        Compile for rv32imc and run under qemu; else compile for this machine.

    Raises
    ------
    ToolError
        If a compiler or the emulator is missing, or compilation fails.
    """

    def __init__(self, folder: Path, distance_m: float, *, emulated: bool = False) -> None:
        harness, program = folder / "pilot_harness.c", folder / "pilot_program"
        shutil.copy(HARNESS, harness)
        compiler = RISCV if emulated else find_host_compiler()
        flags, last = (RISCV_FLAGS, ("-lgcc",)) if emulated else ((), ())
        sources = (harness, folder / "pilot.c")
        line = (compiler, *EXACT, "-O2", *flags, *sources, *last, "-o", program)
        run_program(line, f"compiling {folder / 'pilot.c'}")
        command = [EMULATOR, str(program)] if emulated else [str(program)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._send(np.array([distance_m], "<f8").tobytes())

    def step(self, state: Sequence[float], packet: bytes = b"") -> tuple[float, ...]:
        """Return the command: vx, vy, vz, m/s, and yaw rate, rad/s.

        Parameters
        ----------
        state
            The seven measurements of the reference's ``step``.
        packet
            Packet of detections that has arrived since the last step; empty if none has.
        """
        head = np.array(state, "<f8").tobytes() + np.int32(len(packet)).tobytes()
        self._send(head + packet)
        assert self._process.stdout is not None, "opened with a pipe"
        answer = self._process.stdout.read(32)
        assert len(answer) == 32, "the pilot's program ended"
        return tuple(np.frombuffer(answer, "<f8").tolist())

    def _send(self, data: bytes) -> None:
        assert self._process.stdin is not None, "opened with a pipe"
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()
