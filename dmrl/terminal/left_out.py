"""Count the things that a command leaves out, by reason.

Readers call `leave_out` for each thing that they cannot use. The command that runs them opens a
count: it prints one line for each reason, and the counts go into ``--json`` and the provenance.
Under ``--strict``, the first thing that is left out is an error.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from dmrl.errors import SourceError
from dmrl.terminal.progress import say


@dataclass(slots=True)
class LeftOut:
    """Counts of the things that were left out.

    Parameters
    ----------
    strict
        Raise an error in place of counting.
    counts
        Number of things by reason.
    first
        Place of the first thing by reason: a file, with the line or topic in it.
    """

    strict: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)


_open: list[LeftOut] = []
"""Counts of the commands that run, the innermost last. Threads of a command share its count."""


def leave_out(reason: str, where: object, count: int = 1) -> None:
    """Count things that cannot be used. Without an open count, print a line at once.

    Parameters
    ----------
    reason
        The things in the plural and why they cannot be used, such as ``"ranges over 60 m"``. No
        path and no number that differs from thing to thing.
    where
        Place of the first of them: the file, best with its line, topic or time.
    count
        Number of things; 0: nothing is left out.

    Raises
    ------
    SourceError
        If the open count is strict.
    """
    if not count:
        return
    if not _open:
        say(_describe(reason, count, where))
        return
    held = _open[-1]
    if held.strict:
        raise SourceError(f"{where}: {reason}: {count}. Fix the source, or drop --strict")
    held.counts[reason] += count
    held.first.setdefault(reason, str(where))


@contextmanager
def count_left_out(*, strict: bool = False) -> Iterator[LeftOut]:
    """Count the things left out in the block; print one line for each reason at its end."""
    held = LeftOut(strict)
    _open.append(held)
    try:
        yield held
    finally:
        _open.remove(held)
        for reason, count in held.counts.items():
            say(_describe(reason, count, held.first[reason]))


def count_so_far() -> dict[str, int]:
    """Return the open count by reason; empty if nothing was left out."""
    return dict(_open[-1].counts) if _open else {}


def _describe(reason: str, count: int, where: object) -> str:
    return f"left out: {reason}: {count} ({'at' if count == 1 else 'first at'} {where})"
