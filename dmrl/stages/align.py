"""``dmrl align``: robots that logged on clocks of their own, on one clock."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dmrl.atomic_output import refuse_existing
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import In
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.progress import say

if TYPE_CHECKING:
    from dmrl.estimation.signals.clock_estimation import Clock

METADATA = "dmrl.clocks"
ALL = "*"
"""Name of the correction that moves all of a recording."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The reference clock, and the signals that others are compared by.

    Parameters
    ----------
    reference
        The robot whose times stay, or mocap. Without it, the first by name.
    mocap
        Poses on /tf and /<robot>/pose/truth have motion capture's clock: tie robots to it.
    cameras
        Cameras have clocks of their own: set each by the turns it and its robot both saw.
    steady_cameras
        Pictures that were stamped when they arrived get the even times of a steady camera.
    """

    reference: str | None = None
    mocap: Annotated[bool, Parameter(negative=())] = False
    cameras: Annotated[bool, Parameter(negative=())] = False
    steady_cameras: Annotated[bool, Parameter(negative=())] = False


def run(recording: In, out: Path, settings: Settings) -> "dict[str, Clock]":
    """Synchronise clocks by ranges of pairs, by images, or by motion capture.

    Parameters
    ----------
    recording
        Recording of robots with clocks of their own, such as micro-SD logs; or a folder of them.
    out
        Recording to write: all of IN, on one clock. Must not exist. For a folder: the folder of
        the outputs, under the same names.
    settings
        See `Settings`.

    Returns
    -------
    dict
        By robot, camera (``cf1/camera``) and ``mocap``, how its times were corrected; ``*``: by
        how much all times were moved besides, where one would be before 0.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or no two clocks can be tied to each other.
    SettingError
        If there is no such robot, or the recording has a split or labels, which are by time.
    OutputError
        If ``out`` exists.
    """
    from dmrl.estimation.signals.clock_estimation import Clock
    from dmrl.labelling.clocks.clock_alignment import SIGNALS, Sources, align_clocks, describe_clock
    from dmrl.recording import LoadedRecording, RecordingWriter, build_provenance

    refuse_existing(out)
    held = LoadedRecording(recording, *SIGNALS)
    clocks, corrected = align_clocks(held, Sources(**asdict(settings)))
    later_ns = max(0, -corrected.earliest_ns())
    if later_ns:
        say(f"{recording}: all times are moved by {later_ns / 1e9:.9g} s, as one would be before 0")
        clocks[ALL] = Clock(later_ns * 1e-9, by="no time before 0")
    made = build_provenance("align", settings, [recording], libraries=("numpy",))
    with RecordingWriter(out, made) as sink:
        sink.copy_extras(held.summary)
        described = {name: describe_clock(c, held.start_ns) for name, c in clocks.items()}
        sink.add_metadata(METADATA, {name: json.dumps(one) for name, one in described.items()})
        replace(corrected, later_ns=later_ns).write(sink)
    return clocks


def _document(clocks: "dict[str, Clock]", given: Given) -> dict[str, Any]:
    from dmrl.labelling.clocks.clock_alignment import describe_clock
    from dmrl.recording import read_summary

    start_ns = read_summary(given.recording).start_ns
    described = {name: describe_clock(clock, start_ns) for name, clock in clocks.items()}
    return {"recording": str(given.out), "clocks": described}


def _rows(clocks: "dict[str, Clock]", _: Given) -> list[tuple[str, ...]]:
    rows = []
    for name, c in sorted(clocks.items()):
        offset = (c.offset_s * 1e3, c.drift * 1e6)
        numbers = (*offset, c.sigma_s * 1e3, c.sigma_drift * 1e6, c.correlation)
        rows.append((name, *(f"{number:.3f}" for number in numbers), c.by))
    return rows


COLUMNS = ("clock", "offset, ms", "drift, ppm", "sigma, ms", "sigma, ppm", "correlation", "by")
command = stage_command(
    run,
    Closing(columns=COLUMNS, rows=_rows, document=_document),
    folder="recording",
)
