"""The names that plug-ins of other packages import: base classes, samples and stage helpers.

A name loads its packages on first use. `dmrl.entry_points` finds the plug-ins.
"""

from typing import TYPE_CHECKING

from dmrl.guards.lazy_names import import_lazily

if TYPE_CHECKING:
    from dmrl.flight.pilot import Command as Command
    from dmrl.flight.pilot import Observation as Observation
    from dmrl.flight.pilot import PeerTrack as PeerTrack
    from dmrl.flight.pilot import Pilot as Pilot
    from dmrl.flight.pilot import Task as Task
    from dmrl.formats.base import Content as Content
    from dmrl.formats.base import Format as Format
    from dmrl.formats.base import Options as Options
    from dmrl.learn.networks.architectures import ConvNorm as ConvNorm
    from dmrl.learn.networks.architectures import Network as Network
    from dmrl.pipeline.stage_command import stage_command as stage_command
    from dmrl.recording.provenance_inputs import build_provenance as build_provenance
    from dmrl.samples.flight import iter_ranges as iter_ranges
    from dmrl.samples.flight import merge_by_time as merge_by_time
    from dmrl.samples.flight import to_nanoseconds as to_nanoseconds
    from dmrl.samples.sample import Columns as Columns
    from dmrl.samples.sample import Sample as Sample
    from dmrl.samples.sample import build_image as build_image
    from dmrl.terminal.closing import Closing as Closing
    from dmrl.terminal.left_out import leave_out as leave_out

PLACES = {
    "Closing": "dmrl.terminal.closing",
    "Columns": "dmrl.samples.sample",
    "Command": "dmrl.flight.pilot",
    "Content": "dmrl.formats.base",
    "ConvNorm": "dmrl.learn.networks.architectures",
    "Format": "dmrl.formats.base",
    "Network": "dmrl.learn.networks.architectures",
    "Observation": "dmrl.flight.pilot",
    "Options": "dmrl.formats.base",
    "PeerTrack": "dmrl.flight.pilot",
    "Pilot": "dmrl.flight.pilot",
    "Sample": "dmrl.samples.sample",
    "Task": "dmrl.flight.pilot",
    "build_image": "dmrl.samples.sample",
    "build_provenance": "dmrl.recording.provenance_inputs",
    "merge_by_time": "dmrl.samples.flight",
    "to_nanoseconds": "dmrl.samples.flight",
    "iter_ranges": "dmrl.samples.flight",
    "leave_out": "dmrl.terminal.left_out",
    "stage_command": "dmrl.pipeline.stage_command",
}
"""Names that plug-ins import from here, and their modules, which may move."""

__getattr__ = import_lazily(__name__, PLACES)
