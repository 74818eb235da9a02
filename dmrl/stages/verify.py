"""``dmrl verify``: whether the C of an export computes what the int8 network says."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter, validators
from numpy.typing import NDArray

from dmrl.atomic_output import partial_file
from dmrl.datasets import open_dataset
from dmrl.deploy.backends import seen_by
from dmrl.deploy.c import L1_FOR_STATE
from dmrl.deploy.c.run.compile_targets import targets
from dmrl.deploy.c.run.compiled import require_c
from dmrl.deploy.c.run.measure import Cost, Memory, cost, memory_of, rates
from dmrl.deploy.c.run.verification import TargetResult, expected, prove
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.store import load
from dmrl.deploy.samples import SAMPLES_NAME, load_samples
from dmrl.errors import DatasetError, SettingError, ToolError
from dmrl.terminal.arguments import AsJson, Flat
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

Image = NDArray[np.uint8]
Count = Annotated[int, Parameter(validator=validators.Number(gte=0))]
Name = Literal["gcc", "clang", "sanitizers", "riscv32"]


@dataclass(frozen=True, slots=True)
class Settings:
    """What the C is tried on.

    Parameters
    ----------
    dataset
        Take the images from this dataset, evenly spread over it. Without it: the few that
        came with the export.
    images
        At most so many images.
    noise
        So many images of noise, besides.
    seed
        Of the noise.
    targets
        Try these alone: gcc, clang, sanitizers, riscv32.
    require
        Exit with 1 if a target cannot be tried on this machine.
    """

    dataset: Path | None = None
    images: Count = 8
    noise: Count = 4
    seed: int = 0
    targets: tuple[Name, ...] = ("gcc", "clang", "sanitizers", "riscv32")
    require: Annotated[bool, Parameter(negative=())] = False


@dataclass(frozen=True, slots=True)
class Result:
    """What came of it.

    Parameters
    ----------
    network
        What the C should compute.
    pictures, noise
        Images it was tried on.
    targets
        What each gave.
    cost
        On rv32imc; None without its compiler.
    memory
        What the C keeps.
    """

    network: IntegerNetwork
    pictures: int
    noise: int
    targets: list[TargetResult]
    cost: Cost | None
    memory: Memory

    @property
    def wrong(self) -> bool:
        """Whether a target that was tried failed, or differs from the reference."""
        return any(t.error or t.mismatches for t in self.targets)

    @property
    def skipped(self) -> list[TargetResult]:
        """Targets that were not tried."""
        return [t for t in self.targets if t.skipped]


def run(folder: Path, settings: Settings, out: Path | None = None) -> Result:
    """Compile the C of an export folder in every way, and compare it with the reference.

    Parameters
    ----------
    folder
        What ``dmrl export`` wrote.
    settings
        See `Settings`.
    out
        JSON file to write, as ``dmrl verify --json`` prints. None: nothing is written.

    Raises
    ------
    ModelError
        If the folder is not an export, or is damaged.
    DatasetError, SettingError
        If there are no images to try it on.
    ToolError
        If ``out`` is wanted, but the C is wrong, or a required target cannot be tried.
    OutputError
        If ``out`` exists.
    """
    if out is None:
        return _tried(folder, settings)
    with partial_file(out) as partial:
        result = _tried(folder, settings)
        _require_proof(folder, result, settings)
        text = json.dumps(document(result), indent=1, allow_nan=False)
        partial.write_text(text + "\n", encoding="utf-8")
    return result


def _require_proof(folder: Path, result: Result, settings: Settings) -> None:
    """A proof is of every target: nobody reads the table of a step."""
    if bad := [t for t in result.targets if t.error or t.mismatches]:
        what = bad[0].error or f"{bad[0].mismatches} images differ from the reference"
        raise ToolError(f"{folder}: {bad[0].target}: {what}. See: dmrl verify {folder}")
    if settings.require and result.skipped:
        one = result.skipped[0]
        raise ToolError(f"{folder}: {one.target} not tried: {one.skipped}. Install it")


def _tried(folder: Path, settings: Settings) -> Result:
    network = load(folder)
    require_c(network, folder)
    pictures = _pictures(network, folder, settings)
    noise = _noise(network, settings)
    images = [*pictures, *noise]
    if not images:
        raise SettingError("no images to try the C on. Give --images or --noise above 0")
    wanted = expected(network, list(track(images, "Computing the reference")))
    chosen = [t for t in targets() if t.name in settings.targets]
    tried = [prove(network, folder, t, wanted) for t in track(chosen, "Proving the C")]
    return Result(
        network,
        len(pictures),
        len(noise),
        tried,
        # C that a target could not compile or run is not worth measuring.
        None if any(t.error for t in tried) else cost(network, folder, images[0]),
        memory_of(network, folder),
    )


def _pictures(network: IntegerNetwork, folder: Path, settings: Settings) -> list[Image]:
    """Real images, as the network takes them."""
    if settings.dataset is not None:
        found = _of_dataset(settings.dataset, settings.images)
    elif (folder / SAMPLES_NAME).exists():
        found = list(load_samples(folder)[: settings.images])
    else:
        say(f"no {SAMPLES_NAME} in {folder}: noise alone. Real images: --dataset DIR")
        found = []
    size = (network.height_px, network.width_px)
    if odd := [image.shape[:2] for image in found if image.shape[:2] != size]:
        raise SettingError(
            f"{settings.dataset or folder} holds images of {odd[0][1]} x {odd[0][0]} px, the C "
            f"takes {size[1]} x {size[0]}. Give a dataset of that size"
        )
    return [seen_by(network, image) for image in found]


def _of_dataset(folder: Path, most: int) -> list[Image]:
    data = open_dataset(folder)
    chunks = [chunk for name in data.splits for chunk in data.split(name).pixels]
    starts = np.cumsum([0, *map(len, chunks)])
    if not starts[-1]:
        raise DatasetError(f"{folder} holds no images. Give another dataset")
    rows = np.unique(np.linspace(0, starts[-1] - 1, min(most, int(starts[-1]))).astype(int))
    where = np.searchsorted(starts, rows, side="right") - 1
    return [np.asarray(chunks[k][row - starts[k]]) for k, row in zip(where, rows, strict=True)]


def _noise(network: IntegerNetwork, settings: Settings) -> list[Image]:
    rng = np.random.default_rng(settings.seed)
    shape = (settings.noise, network.height_px, network.width_px, network.channels)
    return list(rng.integers(0, 256, shape, dtype=np.uint8))


def document(result: Result) -> dict[str, Any]:
    """The result for programs."""
    network, found = result.network, result.cost
    executed = found.instructions if found else None
    return {
        "network": network.name,
        "architecture": network.architecture,
        "images": result.pictures,
        "noise_images": result.noise,
        "targets": [
            {
                "target": t.target,
                "mismatches": t.mismatches if not t.skipped else None,
                "skipped": t.skipped or None,
                "error": t.error or None,
                "builds": [asdict(build) for build in t.builds],
            }
            for t in result.targets
        ],
        "macs": network.macs,
        **asdict(result.memory),
        "fits_gap8_l1": result.memory.fits_l1,
        "stack_bytes": stack_bytes(result.targets),
        "code_bytes": found.code_bytes if found else None,
        "constant_bytes": found.constant_bytes if found else None,
        "instructions": executed,
        "instructions_per_mac": executed / network.macs if executed else None,
        "gap8_estimates": [
            {"images_per_s": rate, "assuming": assumption}
            for rate, assumption in rates(network, found, result.memory)
        ],
    }


def stack_bytes(tried: Sequence[TargetResult]) -> int | None:
    """Largest stack measured; None: it was measured nowhere."""
    return max((b.stack_bytes for t in tried for b in t.builds if b.stack_bytes), default=None)


def print_result(folder: Path, result: Result) -> None:
    """Print a row for each build, then what the C costs."""
    columns = ("target", "build", "images", "mismatches", "")
    rows: list[tuple[object, ...]] = []
    for t in result.targets:
        rows += [(t.target, b.label, b.images, b.mismatches, "") for b in t.builds]
        if t.skipped or t.error:
            rows.append(
                (t.target, "", None, None, f"skipped: {t.skipped}" if t.skipped else t.error)
            )
    tried = f"{result.pictures} images and {result.noise} of noise"
    print_table(f"{folder}: the C against the integer reference, {tried}", columns, rows)
    print_table("Cost of the C", ("what", "", "how"), _cost_rows(result))
    for rate, assumption in rates(result.network, result.cost, result.memory):
        print(f"estimated {rate:.2f} images/s on a GAP8: {assumption}")


def _cost_rows(result: Result) -> list[tuple[object, ...]]:
    kept = result.memory
    rows: list[tuple[object, ...]] = [
        ("RAM, bytes", f"{kept.state_bytes:,}", "state, RGB or grey"),
        (
            "fits a GAP8's L1",
            "yes" if kept.fits_l1 else "no",
            f"{L1_FOR_STATE:,} bytes, beside stacks",
        ),
    ]
    if kept.far_bytes:
        rows.append(("far memory, bytes", f"{kept.far_bytes:,}", "no layer works on it"))
        rows.append(("copied, bytes", f"{kept.traffic_bytes:,}", "an image, near and far"))
    if (stack := stack_bytes(result.targets)) is not None:
        rows.append(("stack, bytes", f"{stack:,}", "the most of rv32imc's builds, measured"))
    if found := result.cost:
        rows.append(("code, bytes", f"{found.code_bytes:,}", "rv32imc, gcc -O3"))
        rows.append(("constants, bytes", f"{found.constant_bytes:,}", "rv32imc, gcc -O3"))
        if found.instructions:
            per_mac = found.instructions / result.network.macs
            how = f"rv32imc, gcc -O3, counted by QEMU: {per_mac:.2f} a multiply-accumulate"
            rows.append(("instructions an image", f"{found.instructions:,}", how))
    return rows


DEFAULTS = Settings()


def command(
    folder: Annotated[Path, Parameter(name="OUT_DIR")],
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    as_json: AsJson = False,
) -> int:
    """Prove that the C of an export computes the int8 network, bit for bit.

    Exit status 1 if it does not, or, with --require, if a target cannot be tried here.

    Parameters
    ----------
    folder
        What dmrl export wrote.
    as_json
        Print one JSON document in place of the tables.
    """
    result = run(folder, settings)
    if as_json:
        print_json(document(result))
    else:
        print_result(folder, result)
    return 1 if result.wrong or (settings.require and result.skipped) else 0
