"""``dmrl report``: a folder of recordings, models and evaluations as one page."""

from pathlib import Path

from dmrl.html_report import write
from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import print_json, print_line


def run(folder: Path, out: Path | None = None) -> Path:
    """Write the page of a folder, and say where; see `dmrl.html_report.write`."""
    return write(folder, out)


def command(
    folder: Path,
    out: Path | None = None,
    /,
    *,
    as_json: AsJson = False,
) -> None:
    """Show what a folder comes to, as one HTML page that needs nothing else.

    Images with detections, errors with their intervals, curves of training, maps of int8, positions
    with their ellipses, and where everything comes from. It opens offline, and fetches nothing.

    Parameters
    ----------
    folder
        Folder with recordings, datasets, models and evaluations, such as dmrl run writes.
    out
        Page to write. Without it: report.html in the folder, again if it is there.
    as_json
        Print one JSON document in place of the line.
    """
    written = run(folder, out)
    size = written.stat().st_size
    if as_json:
        print_json({"report": str(written), "bytes": size})
        return
    print_line(f"{written}: {size / 1e6:.1f} MB. Open it in a browser")
