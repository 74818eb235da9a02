"""Recordings: MCAP files, written whole, read fast, mended and checked.

The only home of mcap. Messages are protobuf; times are nanoseconds of log time.
"""

from dmrl.recording.index import SPLIT_METADATA, Summary, TopicInfo, summary
from dmrl.recording.inputs import input_of, provenance
from dmrl.recording.provenance import Input, Provenance
from dmrl.recording.reader import Stamped, columns, matching, read, read_raw, read_table
from dmrl.recording.writer import Channel, RawMessage, RecordingWriter

__all__ = [
    "SPLIT_METADATA",
    "Channel",
    "Input",
    "Provenance",
    "RawMessage",
    "RecordingWriter",
    "Stamped",
    "Summary",
    "TopicInfo",
    "columns",
    "input_of",
    "matching",
    "provenance",
    "read",
    "read_raw",
    "read_table",
    "summary",
]
