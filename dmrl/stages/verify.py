"""``dmrl verify``: proof that the C of an export computes the int8 network."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, validators

from dmrl.atomic_output import atomic_file
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing
from dmrl.terminal.progress import say

if TYPE_CHECKING:
    from dmrl.deploy.c.run.proof import Image, Proof

Count = Annotated[int, Parameter(validator=validators.Number(gte=0))]
Name = Literal["gcc", "clang", "sanitizers", "riscv32"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Images and targets that the C is tried on.

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


def run(
    folder: Annotated[Path, Parameter(name="OUT_DIR")], settings: Settings, out: Path | None = None
) -> "Proof":
    """Prove that the C of an export computes the int8 network, bit for bit.

    Exit status 1 if it does not, or, with --require, if a target cannot be tried here.

    Parameters
    ----------
    folder
        What dmrl export wrote.
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
    from dmrl.deploy.c.run.proof import open_export, prove_export, require_proof

    def prove() -> "Proof":
        network = open_export(folder)
        return prove_export(
            network,
            folder,
            _read_pictures(folder, settings),
            source=settings.dataset or folder,
            noise_images=settings.noise,
            seed=settings.seed,
            names=settings.targets,
        )

    if out is None:
        return prove()
    with atomic_file(out) as partial:
        proof = prove()
        require_proof(folder, proof, all_targets=settings.require)
        text = json.dumps(proof.to_document(), indent=1, allow_nan=False)
        partial.write_text(text + "\n", encoding="utf-8")
    return proof


def _read_pictures(folder: Path, settings: Settings) -> "list[Image]":
    """Return the images of the dataset, or those that came with the export."""
    if settings.dataset is not None:
        from dmrl.datasets.sampling import sample_images

        return sample_images(settings.dataset, settings.images)
    from dmrl.deploy.samples import SAMPLES_NAME, load_samples

    if (folder / SAMPLES_NAME).exists():
        return list(load_samples(folder)[: settings.images])
    say(f"no {SAMPLES_NAME} in {folder}: noise alone. Real images: --dataset DIR")
    return []


command = stage_command(
    run,
    Closing(
        show=lambda proof, given: proof.print(given.folder),
        document=lambda proof, _: proof.to_document(),
    ),
    hidden=("out",),
    status=lambda proof, given: proof.wrong or (given.settings.require and bool(proof.skipped)),
)
