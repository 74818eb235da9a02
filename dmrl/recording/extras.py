"""What copying stages carry over besides messages: metadata and attachments."""

import json

from dmrl.recording.index import SPLIT_METADATA, Summary
from dmrl.recording.provenance import METADATA_NAME
from dmrl.recording.writer import RECIPE_NAME, RecordingWriter


def copy_extras(found: Summary, out: RecordingWriter) -> None:
    """Copy a recording's metadata and attachments into another.

    Its provenance and recipe are left out: they are in the ancestry of the new one.
    """
    for name, records in found.metadata.items():
        if name != METADATA_NAME:
            for values in records:
                out.add_metadata(name, values)
    for name, data in found.attachments.items():
        if name != RECIPE_NAME:
            out.add_attachment(name, "application/octet-stream", data)


def splits(found: Summary) -> dict[str, list[tuple[int, int]]]:
    """The source's own split: by name, log times in [first, last], nanoseconds."""
    out: dict[str, list[tuple[int, int]]] = {}
    for record in found.metadata.get(SPLIT_METADATA, []):
        for name, ranges in record.items():
            out.setdefault(name, []).extend((int(a), int(b)) for a, b in json.loads(ranges))
    return out
