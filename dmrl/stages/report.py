"""``dmrl report``: a folder of recordings, models and evaluations as one page."""

from pathlib import Path
from typing import Any

from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing
from dmrl.terminal.tables import format_size


def run(folder: Path, out: Path | None = None) -> Path:
    """Show the results in a folder as one HTML page that needs nothing else.

    Images with detections, errors with their intervals, curves of training, maps of int8, positions
    with their ellipses, and where everything comes from. It opens offline, and fetches nothing.

    Parameters
    ----------
    folder
        Folder with recordings, datasets, models and evaluations, such as dmrl run writes.
    out
        Page to write. Without it: report.html in the folder, again if it is there.

    Returns
    -------
    Path
        The page.
    """
    from dmrl.html_report import write_html_report

    return write_html_report(folder, out)


def _document(page: Path, _: Any) -> dict[str, Any]:
    return {"report": str(page), "bytes": page.stat().st_size}


def _lines(page: Path, _: Any) -> list[str]:
    return [f"{page}: {format_size(page.stat().st_size)}. Open it in a browser"]


command = stage_command(run, Closing(lines=_lines, document=_document))
