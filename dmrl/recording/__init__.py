"""Read, write, copy, repair and check recordings, which are MCAP files of protobuf messages.

Times are log times in nanoseconds. `reader` reads messages, `writer` writes a recording, and
`summary` reads its topics and metadata. No other package imports mcap.
"""

from dmrl.recording.attachments import copy_extras, splits
from dmrl.recording.checks.check_recording import check, label_findings, say_findings
from dmrl.recording.checks.finding import Finding
from dmrl.recording.copying.edit import merge, trim
from dmrl.recording.copying.resume import Interrupted, interrupted
from dmrl.recording.copying.rewrite import Series, Timed, retime, rewrite, time_slices
from dmrl.recording.licences import LICENCES_METADATA, licence_beside, licence_words, licences
from dmrl.recording.loaded import Contents
from dmrl.recording.log_times import log_times
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.mcap.summary_index import TopicInfo
from dmrl.recording.preview import glance
from dmrl.recording.provenance import Input, Provenance
from dmrl.recording.provenance_inputs import input_of, provenance
from dmrl.recording.reader import (
    Stamped,
    columns,
    matching,
    parsed,
    read,
    read_raw,
    read_table,
    stretches,
)
from dmrl.recording.recover import recover
from dmrl.recording.recovery import Recovery
from dmrl.recording.summary import SPLIT_METADATA, Summary, summary
from dmrl.recording.writer import RecordingWriter

__all__ = [
    "LICENCES_METADATA",
    "SPLIT_METADATA",
    "Channel",
    "Contents",
    "Finding",
    "Input",
    "Interrupted",
    "Provenance",
    "RawMessage",
    "RecordingWriter",
    "Recovery",
    "Series",
    "Stamped",
    "Summary",
    "Timed",
    "TopicInfo",
    "check",
    "columns",
    "copy_extras",
    "glance",
    "input_of",
    "interrupted",
    "label_findings",
    "licence_beside",
    "licence_words",
    "licences",
    "log_times",
    "matching",
    "merge",
    "parsed",
    "provenance",
    "read",
    "read_raw",
    "read_table",
    "recover",
    "retime",
    "rewrite",
    "say_findings",
    "splits",
    "stretches",
    "summary",
    "time_slices",
    "trim",
]
