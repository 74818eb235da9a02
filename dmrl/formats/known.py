"""The one table of formats, in the order in which a source is held against them.

A new format is one file beside this one and one row here; docs/add-a-format.md shows it.
"""

from difflib import get_close_matches
from pathlib import Path

from dmrl.errors import SourceError
from dmrl.formats import (
    aideck_stream,
    cfclient_csv,
    cfusdlog,
    flight_csv,
    hyperflash,
    image_folder,
    locanet,
    nanocockpit,
    ros,
    uwb_tiers,
)
from dmrl.formats.format import Format

# Those with a signature first; any folder with pictures is a folder of pictures.
FORMATS = {
    f.name: f
    for f in (
        locanet.FORMAT,
        flight_csv.FORMAT,
        uwb_tiers.FORMAT,
        ros.FORMAT,
        nanocockpit.FORMAT,
        cfclient_csv.FORMAT,
        cfusdlog.FORMAT,
        aideck_stream.FORMAT,
        hyperflash.FORMAT,
        image_folder.FORMAT,
    )
}


def format_of(source: Path, name: str | None = None) -> Format:
    """The row of ``FORMATS`` for a source.

    Parameters
    ----------
    source
        A file or folder.
    name
        Its format; None: guess.

    Raises
    ------
    SourceError
        If there is no such source or format, or none fits: lists the formats.
    """
    known = ", ".join(FORMATS)
    if not source.exists():
        raise SourceError(f"no file or folder {source}. Name one to convert")
    if not (source.is_file() or source.is_dir()):
        raise SourceError(f"{source} is neither a file nor a folder. Save it to a file first")
    if name is not None and name not in FORMATS:
        near = get_close_matches(name, FORMATS, n=1)
        hint = f"Did you mean {near[0]}? " if near else ""
        raise SourceError(f"--from {name}: no such kind. {hint}Kinds: {known}")
    if name is not None:
        return FORMATS[name]
    if source.is_file() and source.stat().st_size == 0:
        raise SourceError(f"{source} is empty, 0 bytes. Name another file")
    for candidate in FORMATS.values():
        if candidate.recognises(source):
            return candidate
    if source.suffix == ".mcap":
        raise SourceError(f"{source} is a recording already. Say --to: csv, parquet, ros2")
    raise SourceError(f"{source} looks like no kind that is known. Say --from: {known}")
