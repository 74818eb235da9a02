"""``dmrl card``: write the card of a dataset again, or compare the dataset with an older one."""

from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmrl.errors import SettingError
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.tables import print_line, print_table

if TYPE_CHECKING:
    from dmrl.card.changes import Change


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
    published
        Day of publication, such as 2026-11-27, for croissant.json. None: as the card has it.
    """

    title: str | None = None
    license: str | None = None
    published: str | None = None


def run(
    dataset: Path, settings: Settings, out: Path | None = None, *, since: Path | None = None
) -> "Path | list[Change]":
    """Write a dataset's card and figures again; text below its last line is kept.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    settings
        See `Settings`.
    out
        Folder to write, card and figures in it. None: the dataset's own card is written again.
    since
        An older dataset: list the differences from it, and write nothing.

    Returns
    -------
    Path or list[Change]
        The card, or the differences.

    Raises
    ------
    DatasetError
        If the folder is not a dataset, or lacks a shard.
    SettingError
        If the licence is unknown, or the day of publication is not a date.
    OutputError
        If ``out`` exists.
    """
    from dmrl.atomic_output import atomic_folder
    from dmrl.card import write_card

    if since is not None:
        from dmrl.card.changes import compare_datasets

        return compare_datasets(dataset, since)
    _check_date(settings.published)
    if out is None:
        return write_card(dataset, **asdict(settings))
    with atomic_folder(out) as folder:
        card = write_card(dataset, **asdict(settings), into=folder)
    return out / card.name


def _check_date(text: str | None) -> None:
    try:
        date.fromisoformat(text or "2000-01-01")
    except ValueError:
        raise SettingError(f"--published {text} is not a date such as 2026-11-27") from None


def _show(result: "Path | list[Change]", given: Given) -> None:
    if isinstance(result, Path):
        print_line(str(result))
    elif result:
        print_table(f"{given.dataset} since {given.since}", ("what", "before", "now"), result)
    else:
        print_line(f"{given.dataset} and {given.since} do not differ")


def _to_document(result: "Path | list[Change]", _: Given) -> dict[str, Any]:
    if isinstance(result, Path):
        return {"card": str(result)}
    return {"changes": [change._asdict() for change in result]}


command = stage_command(run, Closing(show=_show, document=_to_document), hidden=("out",))
