"""Write the report of a folder into a file."""

import os
from pathlib import Path

from dmrl.atomic_output import partial_file, rewritten_file
from dmrl.errors import OutputError
from dmrl.html_report.collect import gather
from dmrl.html_report.html import MARK
from dmrl.html_report.report_sections import page

NAME = "report.html"


def write(folder: Path, out: Path | None = None) -> Path:
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
    path = folder / NAME if out is None else out
    if path.suffix != ".html":
        raise OutputError(f"{path}: a report is HTML. Name it {path.stem or 'page'}.html")
    again = path.is_file() and not path.is_symlink()
    if again and not path.read_bytes()[:200].decode(errors="replace").count(MARK):
        raise OutputError(f"{path} exists and is not a report of dmrl. Choose another name")
    text = page(gather(Path(os.fspath(folder))))  # a bucket's local copy
    with rewritten_file(path) if again else partial_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return path
