"""How every figure looks, and how it is written. The only home of matplotlib."""

from pathlib import Path
from typing import Any

from dmrl.errors import MissingExtra

try:
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator
except ImportError as e:
    raise MissingExtra("matplotlib", "plot", "a figure") from e

__all__ = ["SIZE_INCHES", "STYLE", "Figure", "MaxNLocator", "mpl", "save"]

# Equal input gives equal bytes: no date, no version, no random ids.
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "dmrl",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
}
METADATA = {".png": {"Software": None}, ".svg": {"Date": None, "Creator": None}}
SIZE_INCHES = (6.0, 3.6)


def save(figure: Figure, stem: Path) -> None:
    """Write ``<stem>.png`` and ``<stem>.svg``."""
    for suffix, metadata in METADATA.items():
        with mpl.rc_context(STYLE):
            figure.savefig(stem.with_suffix(suffix), dpi=150, metadata=metadata)
