"""Find the licence file of a source, and read the licences from recordings' metadata."""

from collections.abc import Iterator
from pathlib import Path

from dmrl.recording.summary import Summary

LICENCES_METADATA = "dmrl.licences"
LICENCE_STEMS = ("LICENSE", "LICENCE", "COPYING")
"""Names of licence files without their suffix."""
TITLE_CHARACTERS_MAX = 100
"""Longest licence title, characters."""


def find_licence_file(source: Path) -> Path | None:
    """Return the licence file in a folder, or next to a file; None if there is none."""
    folder = source if source.is_dir() else source.parent
    try:
        return next(
            (p for p in sorted(folder.iterdir()) if p.stem in LICENCE_STEMS and p.is_file()), None
        )
    except OSError:  # the folder cannot be listed
        return None


def extract_licence_title(path: Path) -> str:
    """Return the first line with text of a licence file, usually the licence's name."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = (line.strip(" #*") for line in text.splitlines())
    return next((line for line in lines if line), "empty")[:TITLE_CHARACTERS_MAX]


def licences_in(found: Summary) -> Iterator[tuple[str, str]]:
    """Yield the name of a source, and its licence, for all that a recording was made from."""
    for values in found.metadata.get(LICENCES_METADATA, []):
        yield from values.items()
