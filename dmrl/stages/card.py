"""``dmrl card``: write the card of a dataset again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.card import write_card


@dataclass(frozen=True, slots=True)
class Settings:
    """What a card says beyond what the data tells.

    Parameters
    ----------
    title
        Name of the dataset. None: as the card has it.
    license
        License, as the Hugging Face Hub spells it, such as cc-by-4.0. None: as the card has it.
    """

    title: str | None = None
    license: str | None = None


DEFAULTS = Settings()


def run(dataset: Path, settings: Settings) -> Path:
    """The card, written into the dataset's folder in place of the one before.

    Raises
    ------
    DatasetError
        If the folder is not a dataset, or lacks a shard.
    """
    return write_card(dataset, title=settings.title, license_id=settings.license)


def command(
    dataset: Path,
    /,
    *,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
) -> None:
    """Write a dataset's card and figures again; your own words below its last line stay.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    """
    print(run(dataset, settings))
