"""How things look in a notebook: tables and pictures as HTML, recordings in rerun."""

import sys
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from dmrl.errors import one_line
from dmrl.images.codec import Rgb, encode_jpeg

MOST_ROWS, MOST_PICTURES = 200, 6


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A title and a table as HTML; names from files cannot become markup."""
    head = "".join(f"<th>{_cell(column)}</th>" for column in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{_cell(value)}</td>" for value in row) + "</tr>"
        for row in rows[:MOST_ROWS]
    )
    more = f"<p>and {len(rows) - MOST_ROWS} more</p>" if len(rows) > MOST_ROWS else ""
    return f"<p><b>{_cell(title)}</b></p><table><tr>{head}</tr>{body}</table>{more}"


def spread(count: int) -> list[int]:
    """Which of so many pictures are shown: the first and others, evenly spaced."""
    shown = min(count, MOST_PICTURES)
    return [k * count // shown for k in range(shown)]


def pictures(title: str, shown: Iterable[Rgb]) -> str:
    """A title and a row of pictures, (H, W, 3) each, as HTML that holds them."""
    coded = (b64encode(encode_jpeg(np.ascontiguousarray(one))).decode() for one in shown)
    row = "".join(f'<img width="160" src="data:image/jpeg;base64,{text}"> ' for text in coded)
    return f"<p><b>{_cell(title)}</b></p><p>{row}</p>"


def _cell(value: object) -> str:
    return escape(f"{value:.4g}" if isinstance(value, float) else one_line(str(value)))


def in_notebook() -> bool:
    """Whether a notebook's kernel runs this."""
    shell = sys.modules.get("IPython")
    return shell is not None and hasattr(shell.get_ipython(), "kernel")


def shown(recordings: Sequence[Path], layout: str | None) -> object:
    """Recordings or a dataset in rerun: in a notebook's cell, else a window until it is closed.

    Raises
    ------
    MissingExtra
        If rerun is not installed.
    """
    viewer = import_module("dmrl.viewer")
    settings = viewer.Settings() if layout is None else viewer.Settings(layout=layout)
    if in_notebook():
        return viewer.Page(recordings, settings)
    return viewer.view(recordings, settings)
