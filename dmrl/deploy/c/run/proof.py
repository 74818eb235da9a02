"""Proof that the C of an export computes the int8 network, and its cost."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.backends import to_network_input
from dmrl.deploy.c import MAX_L1_STATE_BYTES
from dmrl.deploy.c.run import measure
from dmrl.deploy.c.run.compile_targets import list_targets
from dmrl.deploy.c.run.compiled import require_c_files
from dmrl.deploy.c.run.measure import ExecutionCost, StateMemory
from dmrl.deploy.c.run.verification import TargetResult, compute_expected, verify_target
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.store import load_network
from dmrl.errors import SettingError, ToolError
from dmrl.terminal.progress import track
from dmrl.terminal.tables import print_line, print_table

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Proof:
    """Comparison of the C with its reference.

    Parameters
    ----------
    network
        Network that the C should compute.
    pictures, noise
        Images it was tried on.
    targets
        What each gave.
    cost
        On rv32imc, if its compiler is there.
    memory
        State that the C keeps.
    """

    network: IntegerNetwork
    pictures: int
    noise: int
    targets: list[TargetResult]
    cost: ExecutionCost
    memory: StateMemory

    @property
    def wrong(self) -> bool:
        """Whether a target failed, or differs from the reference."""
        return any(t.error or t.mismatches for t in self.targets)

    @property
    def skipped(self) -> list[TargetResult]:
        """Targets that were not tried."""
        return [t for t in self.targets if t.skipped]

    @property
    def stack_bytes(self) -> int | None:
        """Largest stack that was measured; None: none was."""
        sizes = (build.stack_bytes for target in self.targets for build in target.builds)
        return max(filter(None, sizes), default=None)

    def to_document(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        network, found = self.network, self.cost
        executed = found.instructions
        return {
            "network": network.name,
            "architecture": network.architecture,
            "images": self.pictures,
            "noise_images": self.noise,
            "targets": [
                asdict(t) | {"mismatches": None if t.skipped else t.mismatches}
                for t in self.targets
            ],
            "macs": network.macs,
            **asdict(self.memory),
            "fits_gap8_l1": self.memory.fits_l1,
            "stack_bytes": self.stack_bytes,
            **asdict(found),
            "instructions_per_mac": executed / network.macs if executed else None,
            "gap8_estimates": [
                {"images_per_s": rate, "assuming": assumption}
                for rate, assumption in measure.estimate_rates(network, found, self.memory)
            ],
        }

    def print(self, folder: Path) -> None:
        """Print a row for each build, then the cost of the C."""
        columns = ("target", "build", "images", "mismatches", "")
        rows: list[tuple[object, ...]] = []
        for t in self.targets:
            rows += [(t.target, b.label, b.images, b.mismatches, "") for b in t.builds]
            if t.skipped or t.error:
                why = f"skipped: {t.skipped}" if t.skipped else t.error
                rows.append((t.target, "", None, None, why))
        tried = f"{self.pictures} images and {self.noise} of noise"
        print_table(f"{folder}: the C against the integer reference, {tried}", columns, rows)
        print_table("Cost of the C", ("what", "", "how"), self._cost_rows())
        for rate, assumption in measure.estimate_rates(self.network, self.cost, self.memory):
            print_line(f"estimated {rate:.2f} images/s on a GAP8: {assumption}")

    def _cost_rows(self) -> list[tuple[object, ...]]:
        kept = self.memory
        fits, near = "yes" if kept.fits_l1 else "no", f"{MAX_L1_STATE_BYTES:,} bytes, beside stacks"
        found, how = self.cost, "rv32imc, gcc -O3"
        per_mac = (found.instructions or 0) / self.network.macs
        counted = f"{how}, counted by QEMU: {per_mac:.2f} a multiply-accumulate"
        measured = (
            ("far memory, bytes", kept.far_bytes, "no layer works on it"),
            ("copied, bytes", kept.traffic_bytes, "an image, near and far"),
            ("stack, bytes", self.stack_bytes, "the most of rv32imc's builds, measured"),
            ("code, bytes", found.code_bytes, how),
            ("constants, bytes", found.constant_bytes, how),
            ("instructions an image", found.instructions, counted),
        )
        return [
            ("RAM, bytes", f"{kept.state_bytes:,}", "state, RGB or grey"),
            ("fits a GAP8's L1", fits, near),
            *((what, f"{size:,}", how) for what, size, how in measured if size),
        ]


def open_export(folder: Path) -> IntegerNetwork:
    """Return the int8 network of an export folder.

    Raises
    ------
    ModelError
        If the folder is not an export, or is damaged.
    """
    network = load_network(folder)
    require_c_files(network, folder)
    return network


def prove_export(
    network: IntegerNetwork,
    folder: Path,
    pictures: Sequence[Image],
    *,
    source: Path,
    noise_images: int,
    seed: int,
    names: Collection[str],
) -> Proof:
    """Compute the C of an export folder on every target, and compare it with the reference.

    Parameters
    ----------
    network
        Int8 network of the folder.
    folder
        What ``dmrl export`` wrote.
    pictures
        Real images, of the network's size.
    source
        File or folder that they are from: an error names it.
    noise_images
        Number of images of noise.
    seed
        Seed of the noise.
    names
        Targets to try.

    Raises
    ------
    SettingError
        If there are no images, or they are of another size.
    """
    size = (network.height_px, network.width_px)
    if odd := [image.shape[:2] for image in pictures if image.shape[:2] != size]:
        raise SettingError(
            f"{source} holds images of {odd[0][1]} x {odd[0][0]} px, the C takes {size[1]} x "
            f"{size[0]}. Give a dataset of that size"
        )
    shape = (noise_images, network.height_px, network.width_px, network.channels)
    noise = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    images = [*(to_network_input(network, image) for image in pictures), *noise]
    if not images:
        raise SettingError("no images to try the C on. Give --images or --noise above 0")
    wanted = compute_expected(network, list(track(images, "Computing the reference")))
    chosen = [target for target in list_targets() if target.name in names]
    tried = [verify_target(network, folder, t, wanted) for t in track(chosen, "Proving the C")]
    # C that a target could not compile or run is not worth measuring.
    broken = any(t.error for t in tried)
    cost = ExecutionCost() if broken else measure.measure_cost(network, folder, images[0])
    memory = measure.parse_state_memory(network, folder)
    return Proof(network, len(pictures), noise_images, tried, cost, memory)


def require_proof(folder: Path, result: Proof, *, all_targets: bool) -> None:
    """Raise ToolError if the C is wrong, or a target was skipped and all are required.

    Nobody reads the table of a step, so a step fails where the command prints.
    """
    if bad := [t for t in result.targets if t.error or t.mismatches]:
        what = bad[0].error or f"{bad[0].mismatches} images differ from the reference"
        raise ToolError(f"{folder}: {bad[0].target}: {what}. See: dmrl verify {folder}")
    if all_targets and result.skipped:
        one = result.skipped[0]
        raise ToolError(f"{folder}: {one.target} not tried: {one.skipped}. Install it")
