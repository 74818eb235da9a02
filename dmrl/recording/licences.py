"""Licences that lie beside what recordings were made from, carried along as metadata."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from dmrl.recording.summary import summary

LICENCES_METADATA = "dmrl.licences"
NAMES = ("LICENSE", "LICENCE", "COPYING")
LINE_MAX = 100


def licence_beside(source: Path) -> Path | None:
    """The file with the licence of a source, in a folder or beside a file; None: there is none."""
    folder = source if source.is_dir() else source.parent
    try:
        return next((p for p in sorted(folder.iterdir()) if p.stem in NAMES and p.is_file()), None)
    except OSError:  # a folder that may not be listed
        return None


def licence_words(path: Path) -> str:
    """What a file with a licence says first: as a rule, which it is."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = (line.strip(" #*") for line in text.splitlines())
    return next((line for line in lines if line), "empty")[:LINE_MAX]


def licences(recordings: Sequence[Path]) -> dict[str, str]:
    """Licences by the names of what recordings were made from, as far as they were found.

    Raises
    ------
    RecordingError
        If a recording cannot be read.
    """
    return dict(sorted(pair for path in recordings for pair in _told(path)))


def _told(path: Path) -> Iterator[tuple[str, str]]:
    for values in summary(path).metadata.get(LICENCES_METADATA, []):
        yield from values.items()
