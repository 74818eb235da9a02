"""Compile targets of the verification: compilers, their flags, and how each program is run."""

from dataclasses import dataclass
from pathlib import Path

from dmrl.deploy.c import c_name
from dmrl.deploy.c.harness import generate_harness
from dmrl.deploy.c.run.toolchain import EMULATOR, RISCV, find_missing, run_program
from dmrl.deploy.int8.network import IntegerNetwork

RISCV_FLAGS = ("-march=rv32imc", "-mabi=ilp32", "-nostdlib", "-nostartfiles", "-ffreestanding",
               "-Wl,--no-relax")  # fmt: skip
"""Flags for rv32imc without libraries. Without start-up code, no code sets the register for
relaxation."""
SANITIZER_FLAGS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all",
              "-DHARNESS_GUARD")  # fmt: skip
OPTIMIZATION_LEVELS = ("-O0", "-O1", "-O2", "-O3")


@dataclass(frozen=True, slots=True)
class Build:
    """One configuration in which the C is compiled.

    Parameters
    ----------
    label
        Settings, for display.
    compiler
        Compiler program.
    flags
        Flags of the compiler.
    bayer
        Whether it takes raw mosaics.
    emulated
        Whether the program runs in the emulator.
    """

    label: str
    compiler: str
    flags: tuple[str, ...]
    bayer: bool = False
    emulated: bool = False

    def compile_program(
        self, network: IntegerNetwork, folder: Path, build: Path
    ) -> list[str | Path]:
        """Compile the C of an export folder; return the command that runs the program.

        Parameters
        ----------
        network
            Network of the C.
        folder
            Export folder.
        build
            Folder for compiled files.

        Raises
        ------
        ToolError
            If compilation fails.
        """
        harness_c, program = build / "harness.c", build / "program"
        harness_c.write_text(generate_harness(network), encoding="utf-8")
        name = c_name(network)
        mode = f"-D{name.upper()}_BAYER={int(self.bayer)}"
        flags: tuple[str | Path, ...] = (*self.flags, mode, "-iquote", folder)
        if "-DHARNESS_GUARD" in flags:
            flags = (*flags, f"-D{name.upper()}_COPY=harness_copy")
        sources = [harness_c, folder / f"{name}.c"]
        last: tuple[str, ...] = ("-lgcc",) if self.emulated else ()
        what = f"{self.compiler} {self.label}"
        run_program((self.compiler, "-std=gnu99", *flags, *sources, *last, "-o", program), what)
        return [EMULATOR, program] if self.emulated else [program]


@dataclass(frozen=True, slots=True)
class Target:
    """A compiler or checker, with all its builds."""

    name: str
    builds: tuple[Build, ...]

    @property
    def skipped(self) -> str:
        """Reason why it cannot run on this machine; empty if it can."""
        needed = [self.builds[0].compiler]
        return find_missing(*needed, *([EMULATOR] if self.builds[0].emulated else []))


def list_targets() -> tuple[Target, ...]:
    """Return every target."""
    builds = {
        name: [
            *(Build(level, name, (level,)) for level in OPTIMIZATION_LEVELS),
            Build("-O3 Bayer", name, ("-O3",), bayer=True),
        ]
        for name in ("gcc", "clang")
    }
    # gcc includes its sanitizers; those of clang are a separate package.
    checker = "clang" if find_missing("gcc") and not find_missing("clang") else "gcc"
    label = f"{checker} address, undefined"
    builds["sanitizers"] = [
        Build(label, checker, SANITIZER_FLAGS),
        Build(f"{label}, Bayer", checker, SANITIZER_FLAGS, bayer=True),
    ]
    builds["riscv32"] = [
        Build(label, RISCV, (label[:3], *RISCV_FLAGS), bayer="Bayer" in label, emulated=True)
        for label in ("-O3", "-Os", "-O3 Bayer")
    ]
    return tuple(Target(name, tuple(own)) for name, own in builds.items())
