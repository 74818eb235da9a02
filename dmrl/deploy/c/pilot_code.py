"""C of the pilot, and programs that run it step by step on this machine or under qemu."""

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from dmrl import __version__
from dmrl.deploy.c.run.compile_targets import RISCV_FLAGS
from dmrl.deploy.c.run.toolchain import EMULATOR, RISCV, find_host_compiler, run_program
from dmrl.deploy.c.templating import fill_template
from dmrl.errors import ToolError
from dmrl.geometry.frames import Camera

EXACT = ("-std=gnu99", "-ffp-contract=off")
"""Flags with which the commands are those of the reference, bit for bit."""
PILOT_BYTES = 1240
"""Memory of the pilot's state, which the caller owns; it has no other."""


def write_pilot(
    folder: Path, camera: Camera, constants: Mapping[str, float], detections_max: int
) -> None:
    """Write pilot.c and pilot.h.

    Parameters
    ----------
    folder
        Folder of the files.
    camera
        Pinhole camera of the detections.
    constants, detections_max
        Those of the reference, `dmrl.flight.onboard_pilot`.
    """
    lens = {"FX": camera.fx_px, "FY": camera.fy_px, "CX": camera.cx_px, "CY": camera.cy_px}
    values = {name: repr(value) for name, value in {**constants, **lens}.items()}
    values |= {"DETECTIONS_MAX": str(detections_max), "version": __version__}
    for name in ("pilot.c", "pilot.h"):
        (folder / name).write_text(fill_template(name, **values), encoding="utf-8")


class CompiledPilot:
    """The pilot's C as a process that answers step by step.

    Parameters
    ----------
    folder
        Folder with pilot.c and pilot.h; the program is built there.
    distance_m
        Distance to keep.
    emulated
        Compile for rv32imc and run it under qemu, in place of this machine.

    Raises
    ------
    ToolError
        If a compiler or the emulator is missing, or compilation fails.
    """

    def __init__(self, folder: Path, distance_m: float, *, emulated: bool = False) -> None:
        harness, program = folder / "pilot_harness.c", folder / "pilot_program"
        harness.write_text(fill_template("pilot_harness.c"), encoding="utf-8")
        compiler = RISCV if emulated else find_host_compiler()
        flags, last = (RISCV_FLAGS, ("-lgcc",)) if emulated else ((), ())
        sources = (harness, folder / "pilot.c")
        line = (compiler, *EXACT, "-O2", *flags, *sources, *last, "-o", program)
        run_program(line, f"compiling {folder / 'pilot.c'}")
        command = [EMULATOR, str(program)] if emulated else [str(program)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._send(np.array([distance_m], "<f8").tobytes())

    def step(self, state: Sequence[float], packet: bytes = b"") -> tuple[float, ...]:
        """Return vx, vy, vz and the yaw rate.

        Parameters
        ----------
        state
            The seven measurements of the reference's ``step``.
        packet
            A packet of detections that has arrived since the last step; empty: none has.
        """
        head = np.array(state, "<f8").tobytes() + np.int32(len(packet)).tobytes()
        self._send(head + packet)
        assert self._process.stdout is not None, "opened with a pipe"
        answer = self._process.stdout.read(32)
        if len(answer) != 32:
            raise ToolError("the pilot's program ended. Export it again")
        return tuple(np.frombuffer(answer, "<f8").tolist())

    def _send(self, data: bytes) -> None:
        assert self._process.stdin is not None, "opened with a pipe"
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()
