"""Write the report of a folder into a file."""

import os
from pathlib import Path

from dmrl.atomic_output import atomic_file, replace_file
from dmrl.errors import OutputError
from dmrl.html_report.blocks import REPORT_MARK
from dmrl.html_report.collect import collect_outputs
from dmrl.html_report.report_sections import build_report

REPORT_FILE = "report.html"


def write_html_report(folder: Path, out: Path | None = None) -> Path:
    """Write the report of a folder; an existing report is replaced.

    Parameters
    ----------
    folder
        Folder with recordings, datasets, models or evaluations.
    out
        File to write. None: report.html in the folder.

    Raises
    ------
    SettingError
        If the folder contains no output.
    MissingExtra
        If matplotlib is not installed.
    OutputError
        If another file has that name, or the report cannot be written.
    """
    path = folder / REPORT_FILE if out is None else out
    if path.suffix != ".html":
        raise OutputError(f"{path}: a report is HTML. Name it {path.stem or 'page'}.html")
    again = path.is_file() and not path.is_symlink()
    if again and not path.read_bytes()[:200].decode(errors="replace").count(REPORT_MARK):
        raise OutputError(f"{path} exists and is not a report of dmrl. Choose another name")
    text = build_report(collect_outputs(Path(os.fspath(folder))))  # a bucket's local copy
    with replace_file(path) if again else atomic_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return path
