"""Style and output of all figures."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from dmrl.errors import MissingExtra


@contextmanager
def _ignore_backend() -> Iterator[None]:
    """Ignore MPLBACKEND while matplotlib is imported.

    Figures are written to files and need no backend, but matplotlib cannot be imported if the
    backend in MPLBACKEND is not installed. Notebooks set it.
    """
    wanted = None if "matplotlib" in sys.modules else os.environ.pop("MPLBACKEND", None)
    try:
        yield
    finally:
        if wanted is not None:
            os.environ["MPLBACKEND"] = wanted
    if wanted is not None:
        with suppress(ValueError):
            mpl.rcParams["backend"] = wanted  # so that the notebook shows its later plots


try:
    with _ignore_backend():
        import matplotlib as mpl
        from matplotlib.figure import Figure
        from matplotlib.patheffects import withStroke
        from matplotlib.ticker import LogFormatter, MaxNLocator
except ImportError as e:
    raise MissingExtra("matplotlib", "plot", "a figure") from e

__all__ = ["Figure", "MaxNLocator", "mpl", "withStroke"]

# No date, version or random ids, so that equal input gives equal bytes.
STYLE: dict[Any, Any] = {
    "text.parse_math": False,  # names come from files: a $ in them is no formula
    "svg.hashsalt": "dmrl",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
}
METADATA = {".png": {"Software": None}, ".svg": {"Date": None, "Creator": None}}
SIZE_INCHES = (6.0, 3.6)


class _PlainFormatter(LogFormatter):
    """Formatter with matplotlib's choice of numbers, written plainly."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def use_plain_numbers(axis: Any) -> None:
    """Set plain numbers on a logarithmic axis: formulas are disabled, see `STYLE`."""
    axis.set_major_formatter(_PlainFormatter())
    axis.set_minor_formatter(_PlainFormatter(minor_thresholds=(1.5, 0.5)))


@contextmanager
def open_figure(stem: Path, size: tuple[float, float] = SIZE_INCHES) -> Iterator[Figure]:
    """Yield a figure of this size, inches; write ``<stem>.png`` and ``<stem>.svg`` at the end."""
    with mpl.rc_context(STYLE):
        figure = Figure(size, layout="constrained")
        yield figure
        for suffix, metadata in METADATA.items():
            figure.savefig(stem.with_name(stem.name + suffix), dpi=150, metadata=metadata)


def add_legend_below(figure: Figure, axes: Any, **how: Any) -> None:
    """Add the legend of some axes below all axes, where it covers no curve."""
    handles, names = axes.get_legend_handles_labels()
    at: dict[str, Any] = {"loc": "outside lower center", "fontsize": 8, "frameon": False}
    figure.legend(handles, names, **(at | how))
