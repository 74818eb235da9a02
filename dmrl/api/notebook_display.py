"""Display in notebooks: tables and images as HTML, recordings in rerun."""

import sys
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from dmrl.errors import to_one_line
from dmrl.images.codec import Rgb, encode_jpeg

MAX_ROWS, MAX_IMAGES = 200, 6


def html_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a title and a table as HTML; names from files cannot become markup."""
    head = "".join(f"<th>{_cell_text(column)}</th>" for column in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{_cell_text(value)}</td>" for value in row) + "</tr>"
        for row in rows[:MAX_ROWS]
    )
    more = f"<p>and {len(rows) - MAX_ROWS} more</p>" if len(rows) > MAX_ROWS else ""
    return f"<p><b>{_cell_text(title)}</b></p><table><tr>{head}</tr>{body}</table>{more}"


def pick_even_indices(count: int) -> list[int]:
    """Return the indices of the images to show: the first and others, evenly spaced."""
    shown = min(count, MAX_IMAGES)
    return [k * count // shown for k in range(shown)]


def html_images(title: str, shown: Iterable[Rgb]) -> str:
    """Return a title and a row of images, (H, W, 3) each, as HTML that contains them."""
    coded = (b64encode(encode_jpeg(np.ascontiguousarray(one))).decode() for one in shown)
    row = "".join(f'<img width="160" src="data:image/jpeg;base64,{text}"> ' for text in coded)
    return f"<p><b>{_cell_text(title)}</b></p><p>{row}</p>"


def _cell_text(value: object) -> str:
    return escape(f"{value:.4g}" if isinstance(value, float) else to_one_line(str(value)))


def is_in_notebook() -> bool:
    """Return whether a notebook's kernel runs this."""
    shell = sys.modules.get("IPython")
    return shell is not None and hasattr(shell.get_ipython(), "kernel")


def show_in_rerun(recordings: Sequence[Path], layout: str | None) -> object:
    """Show recordings or a dataset in rerun: in a notebook's cell, else in a window.

    Raises
    ------
    MissingExtra
        If rerun is not installed.
    """
    viewer = import_module("dmrl.viewer")
    settings = viewer.Settings() if layout is None else viewer.Settings(layout=layout)
    if is_in_notebook():
        return viewer.Page(recordings, settings)
    return viewer.view(recordings, settings)
