"""Read, write, copy, repair and check recordings, which are MCAP files of protobuf messages.

Times are log times in nanoseconds. `reader` reads messages, `writer` writes a recording, and
`summary` reads its topics and metadata. No other package imports mcap.
"""

from dmrl.recording.attachments import copy_metadata_and_attachments, read_splits
from dmrl.recording.checks.check_recording import check, list_label_findings, print_findings
from dmrl.recording.checks.finding import Finding
from dmrl.recording.copying.edit import merge, trim
from dmrl.recording.copying.resume import InterruptedRecording, recover_interrupted
from dmrl.recording.copying.rewrite import (
    Series,
    TimedMessage,
    iter_time_slices,
    rewrite,
    shift_times,
)
from dmrl.recording.licences import (
    LICENCES_METADATA,
    extract_licence_title,
    find_licence_file,
    read_licences,
)
from dmrl.recording.loaded import LoadedRecording
from dmrl.recording.log_times import read_log_times
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.preview import sample_topics
from dmrl.recording.provenance import Input, Provenance
from dmrl.recording.provenance_inputs import build_input, build_provenance
from dmrl.recording.reader import (
    Stamped,
    iter_columns,
    iter_topic_batches,
    match_topics,
    parse_message,
    read,
    read_raw,
    read_table,
)
from dmrl.recording.recover import recover
from dmrl.recording.recovery_report import Recovery
from dmrl.recording.summary import SPLIT_METADATA, Summary, TopicInfo, read_summary
from dmrl.recording.writer import RecordingWriter

__all__ = [
    "LICENCES_METADATA",
    "SPLIT_METADATA",
    "Channel",
    "Finding",
    "Input",
    "InterruptedRecording",
    "LoadedRecording",
    "Provenance",
    "RawMessage",
    "RecordingWriter",
    "Recovery",
    "Series",
    "Stamped",
    "Summary",
    "TimedMessage",
    "TopicInfo",
    "build_input",
    "build_provenance",
    "check",
    "copy_metadata_and_attachments",
    "extract_licence_title",
    "find_licence_file",
    "iter_columns",
    "iter_time_slices",
    "iter_topic_batches",
    "list_label_findings",
    "match_topics",
    "merge",
    "parse_message",
    "print_findings",
    "read",
    "read_licences",
    "read_log_times",
    "read_raw",
    "read_splits",
    "read_summary",
    "read_table",
    "recover",
    "recover_interrupted",
    "rewrite",
    "sample_topics",
    "shift_times",
    "trim",
]
