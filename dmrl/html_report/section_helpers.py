"""Helpers of the sections of a report."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dmrl.html_report.html import (
    INVALID_DATA_ERRORS,
    ImageEmbedder,
    build_chart,
    to_html_text,
)

Documents = Mapping[str, Mapping[str, Any]]


def show_documents(documents: Documents, show: Callable[[str, Any], str]) -> str:
    """Show every document; name one that does not have dmrl's form."""
    parts = []
    for name, said in documents.items():
        try:
            parts.append(show(name, said))
        except INVALID_DATA_ERRORS as e:
            parts.append(
                f"<p>{to_html_text(name)} does not have dmrl's form ({to_html_text(repr(e))}).</p>"
            )
    return "".join(parts)


def extract_valid(documents: Documents, take: Callable[[Any], Any]) -> dict[str, Any]:
    """Apply ``take`` to every document that has the values it needs."""
    out = {}
    for name, said in documents.items():
        try:
            out[name] = take(said)
        except INVALID_DATA_ERRORS:
            continue
    return out


def draw_or_explain(draw: Callable[..., str], *given: Any, caption: str) -> str:
    """Draw a chart; a line of text if its data are invalid."""
    try:
        return build_chart(draw(*given), caption)
    except INVALID_DATA_ERRORS as e:
        return f"<p>{to_html_text(caption)}: cannot be drawn ({to_html_text(repr(e))}).</p>"


def figure_if_present(path: Path, caption: str, pictures: ImageEmbedder) -> str:
    """Return the figure of an image file; an empty string if there is none."""
    there = path.is_file() and not path.is_symlink()
    return pictures.build_figure(path, caption, full="images" in caption) if there else ""


def shorten(value: object, most: int = 60) -> str:
    """Truncate a value's text to a number of characters."""
    words = str(value)
    return words if len(words) <= most else words[: most - 3] + "..."
