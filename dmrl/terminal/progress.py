"""Progress on standard error or in a notebook, silent when that is neither."""

from collections.abc import Callable, Iterable, Iterator, Sized
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from dmrl.errors import one_line

Item = TypeVar("Item")


def track(
    items: Iterable[Item],
    what: str,
    total: int | None = None,
    *,
    describe: Callable[[Item], str] | None = None,
) -> Iterator[Item]:
    """Items one by one, with a bar that says how many are done.

    Parameters
    ----------
    items
        Anything to iterate.
    what
        Words before the bar, such as "Rendering".
    total
        Number of items. None: the length of ``items``, or not known.
    describe
        Words before the bar once an item is there, in place of ``what``.

    Yields
    ------
    Item
        What ``items`` yields, unchanged.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    console = Console(stderr=True)
    if not (console.is_terminal or console.is_jupyter):
        yield from items
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        for item in items:
            if describe is not None:
                bar.update(task, description=describe(item))
            yield item
            bar.advance(task)


def say(line: str) -> None:
    """Print one line of news on standard error, terminal or not."""
    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(one_line(line))
