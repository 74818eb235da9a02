"""``dmrl card``: write the card of a dataset again."""

from dataclasses import dataclass
from pathlib import Path

from dmrl.atomic_output import partial_folder
from dmrl.card import write_card
from dmrl.terminal.arguments import Flat
from dmrl.terminal.tables import print_line


@dataclass(frozen=True, slots=True)
class Settings:
    """What a card says beyond what the data tells.

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


DEFAULTS = Settings()


def run(dataset: Path, settings: Settings, out: Path | None = None) -> Path:
    """The card, written into the dataset's folder in place of the one before, or into ``out``.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    settings
        See `Settings`.
    out
        Folder to write, card and figures in it. None: the dataset's own card is written again.

    Raises
    ------
    DatasetError
        If the folder is not a dataset, or lacks a shard.
    OutputError
        If ``out`` exists.
    """
    if out is None:
        return write_card(dataset, title=settings.title, license_id=settings.license)
    with partial_folder(out) as folder:
        card = write_card(dataset, title=settings.title, license_id=settings.license, into=folder)
    return out / card.name


def command(
    dataset: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
) -> None:
    """Write a dataset's card and figures again; your own words below its last line stay.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    """
    print_line(str(run(dataset, settings)))
