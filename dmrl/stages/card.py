"""``dmrl card``: write the card of a dataset again."""

from dataclasses import dataclass
from pathlib import Path

from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing


@dataclass(frozen=True, slots=True)
class Settings:
    """Words of a card that do not follow from the data.

    Parameters
    ----------
    title
        Name of the dataset. None: as the card has it.
    license
        License: an SPDX identifier such as cc-by-4.0, or unknown, other. None: as the card has
        it.
    """

    title: str | None = None
    license: str | None = None


def run(dataset: Path, settings: Settings, out: Path | None = None) -> Path:
    """Write a dataset's card and figures again; text below its last line is kept.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    settings
        See `Settings`.
    out
        Folder to write, card and figures in it. None: the dataset's own card is written again.

    Returns
    -------
    Path
        The card.

    Raises
    ------
    DatasetError
        If the folder is not a dataset, or lacks a shard.
    OutputError
        If ``out`` exists.
    """
    from dmrl.atomic_output import atomic_folder
    from dmrl.card import write_card

    if out is None:
        return write_card(dataset, title=settings.title, license_id=settings.license)
    with atomic_folder(out) as folder:
        card = write_card(dataset, title=settings.title, license_id=settings.license, into=folder)
    return out / card.name


command = stage_command(run, Closing(lines=lambda card, _: [str(card)]), hidden=("out",))
