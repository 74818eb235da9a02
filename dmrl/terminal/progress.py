"""Progress on standard error: a bar in a terminal or notebook, a line a minute in a file."""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from functools import lru_cache
from importlib import import_module
from time import monotonic
from typing import TypeVar

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from dmrl.errors import to_one_line

Item = TypeVar("Item")
Lines = Sequence[Sequence[object]]
NOTEBOOK_PERIOD_S = 0.3
"""Time between two updates of the line in a notebook, seconds."""
LOG_PERIOD_S = 60.0
"""Time between two lines where standard error is a file or a pipe, seconds."""


class _Progress(Progress):
    """Bars, with a table below them where there is one."""

    below: Callable[[], Lines] | None = None

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the bars, and the table below them."""
        yield from super().get_renderables()
        lines = self.below() if self.below is not None else ()
        if len(lines) > 1:
            shown = Table(*map(_cell_text, lines[0]), box=None, header_style="dim")
            for line in lines[1:]:
                shown.add_row(*map(_cell_text, line))
            yield shown


def _cell_text(value: object) -> str:
    return escape(to_one_line(f"{value:.1f}" if isinstance(value, float) else str(value)))


def track(
    items: Iterable[Item],
    what: str,
    total: int | None = None,
    *,
    describe: Callable[[Item], str] | None = None,
    below: Callable[[], Lines] | None = None,
) -> Iterator[Item]:
    """Yield items unchanged, with a bar that shows how many are done.

    Parameters
    ----------
    items
        Anything to iterate.
    what
        Words before the bar, such as "Rendering".
    total
        Number of items. None: the length of ``items``, or unknown.
    describe
        Return the words before the bar for an item, in place of ``what``.
    below
        Return the rows of a table below the bar, its head first; called ten times a second, from
        another thread.

    Yields
    ------
    Item
        The items, unchanged.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    console = Console(stderr=True)
    if console.is_jupyter:
        yield from _track_in_notebook(items, what, total, describe)
        return
    if not console.is_terminal:
        yield from _track_in_log(items, what, total, describe)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with _Progress(*columns, console=console, transient=True) as bar:
        bar.below = below
        task = bar.add_task(what, total=total)
        for item in items:
            if describe is not None:
                bar.update(task, description=describe(item))
            yield item
            bar.advance(task)


def _track_in_notebook(
    items: Iterable[Item], what: str, total: int | None, describe: Callable[[Item], str] | None
) -> Iterator[Item]:
    """Yield items, with a line in the notebook's cell; rich's bars would need ipywidgets."""

    def text(words: str) -> dict[str, str]:
        return {"text/plain": to_one_line(words)}

    shown = import_module("IPython.display").display(text(what), raw=True, display_id=True)
    due_s = 0.0
    for done, item in enumerate(items):
        if (now_s := monotonic()) >= due_s:
            due_s = now_s + NOTEBOOK_PERIOD_S
            words = what if describe is None else describe(item)
            shown.update(text(f"{words}: {done}" + (f" of {total}" if total else "")), raw=True)
        yield item
    shown.update(text(""), raw=True)


def _track_in_log(
    items: Iterable[Item], what: str, total: int | None, describe: Callable[[Item], str] | None
) -> Iterator[Item]:
    """Yield items, with a line now and then for work that lasts."""
    begun_s = monotonic()
    due_s = begun_s + LOG_PERIOD_S
    for done, item in enumerate(items):
        if done and (now_s := monotonic()) >= due_s:
            due_s = now_s + LOG_PERIOD_S
            words = f"{what if describe is None else describe(item)}: {done}"
            if total:
                left_min = (now_s - begun_s) / done * (total - done) / 60
                words += f" of {total}, about {left_min:.0f} min left"
            say(words)
        yield item


def say(line: str) -> None:
    """Print one line of news on standard error, terminal or not."""
    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(to_one_line(line))


def announce_import(package: str) -> None:
    """Say that a package is being loaded, unless it is: torch takes seconds."""
    if package not in sys.modules:
        say(f"loading {package}")


@lru_cache(maxsize=4096)
def say_once(line: str) -> None:
    """Print one line of news, unless this process printed the same line before."""
    say(line)
