"""Read, write, copy, repair and check recordings, which are MCAP files of protobuf messages.

Times are log times in nanoseconds. `reader` reads messages, `writer` writes a recording, and
`summary` reads its topics and metadata. No other package imports mcap.
"""

from dmrl.recording.checks.check_recording import check as check
from dmrl.recording.checks.check_recording import list_label_findings as list_label_findings
from dmrl.recording.checks.check_recording import print_findings as print_findings
from dmrl.recording.checks.scan import Finding as Finding
from dmrl.recording.copying.edit import merge as merge
from dmrl.recording.copying.edit import trim as trim
from dmrl.recording.copying.resume import InterruptedRecording as InterruptedRecording
from dmrl.recording.copying.resume import recover_interrupted as recover_interrupted
from dmrl.recording.copying.rewrite import iter_time_slices as iter_time_slices
from dmrl.recording.copying.rewrite import rewrite as rewrite
from dmrl.recording.copying.rewrite import shift_times as shift_times
from dmrl.recording.licences import LICENCES_METADATA as LICENCES_METADATA
from dmrl.recording.licences import extract_licence_title as extract_licence_title
from dmrl.recording.licences import find_licence_file as find_licence_file
from dmrl.recording.loaded import LoadedRecording as LoadedRecording
from dmrl.recording.log_times import read_log_times as read_log_times
from dmrl.recording.mcap.channel import Channel as Channel
from dmrl.recording.mcap.channel import RawMessage as RawMessage
from dmrl.recording.mcap.file import name_recordings as name_recordings
from dmrl.recording.preview import sample_topics as sample_topics
from dmrl.recording.provenance import Input as Input
from dmrl.recording.provenance import Provenance as Provenance
from dmrl.recording.provenance_inputs import build_input as build_input
from dmrl.recording.provenance_inputs import build_provenance as build_provenance
from dmrl.recording.reader import Stamped as Stamped
from dmrl.recording.reader import iter_columns as iter_columns
from dmrl.recording.reader import iter_topic_batches as iter_topic_batches
from dmrl.recording.reader import match_topics as match_topics
from dmrl.recording.reader import parse_message as parse_message
from dmrl.recording.reader import read as read
from dmrl.recording.reader import read_raw as read_raw
from dmrl.recording.reader import read_table as read_table
from dmrl.recording.recover import recover as recover
from dmrl.recording.recovery_scan import Recovery as Recovery
from dmrl.recording.summary import SPLIT_METADATA as SPLIT_METADATA
from dmrl.recording.summary import Summary as Summary
from dmrl.recording.summary import TopicInfo as TopicInfo
from dmrl.recording.summary import read_splits as read_splits
from dmrl.recording.summary import read_summary as read_summary
from dmrl.recording.writer import RecordingWriter as RecordingWriter
