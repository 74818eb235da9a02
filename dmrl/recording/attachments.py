"""Copy the metadata and attachments of a recording, and read the split in its metadata."""

from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.safe_names import check_split_name
from dmrl.recording.mcap import checksums
from dmrl.recording.provenance import METADATA_NAME
from dmrl.recording.summary import SPLIT_METADATA, Summary
from dmrl.recording.writer import RECIPE_NAME, RecordingWriter


def copy_metadata_and_attachments(summary: Summary, out: RecordingWriter) -> None:
    """Copy a recording's metadata and attachments into another.

    Provenance and recipe are left out: the provenance of the new recording includes them.
    """
    for name, records in summary.metadata.items():
        if name not in (METADATA_NAME, checksums.METADATA_NAME):
            for values in records:
                out.add_metadata(name, values)
    for attachment in summary.attachments:
        if attachment.name != RECIPE_NAME:
            out.copy_attachment(attachment)


def read_splits(path: Path, summary: Summary) -> dict[str, list[tuple[int, int]]]:
    """Return the split that the source defines: name to log times in [first, last], nanoseconds.

    Parameters
    ----------
    path
        The recording, for errors.
    found
        Summary of the recording.

    Raises
    ------
    RecordingError
        If the metadata is malformed.
    UnsafeName
        If the name of a split cannot be a folder name.
    """
    out: dict[str, list[tuple[int, int]]] = {}
    try:
        for record in summary.metadata.get(SPLIT_METADATA, []):
            for name, ranges in record.items():
                check_split_name(name, f"{path}: a split")
                out.setdefault(name, []).extend((int(a), int(b)) for a, b in parse_json(ranges))
    except (ValueError, TypeError) as e:
        raise RecordingError(
            f"{path}: its split is not a list of [start_ns, end_ns] ({e}). "
            "Convert it again, or ignore it with --split recordings"
        ) from None
    return out
