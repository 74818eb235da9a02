"""``dmrl label``: positions of peers from ranges and odometry, and labels of the images."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, validators

from dmrl.atomic_output import refuse_existing
from dmrl.errors import optional_imports
from dmrl.estimation.model.gate import BAD_SHARE, GATE_M, Gate
from dmrl.pipeline.parallel_map import parallel_map
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import In, Positive, Strict
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.tables import print_table

if TYPE_CHECKING:
    from dmrl.labelling.pair_report import PairReport


@dataclass(frozen=True, slots=True)
class Settings:
    """Method of estimation, errors of the sensors, and cameras.

    Parameters
    ----------
    method
        "swarm": the whole flight at once, and all robots together that ranges connect. "batch": the
        same, pair by pair. "ekf": the published filter, online, from (0, 0, 0).
    preset
        ekf: its noise, as published for simulation or in the firmware.
    gate_m
        Horizontal error, in metres, beyond which a position is bad.
    bad_share
        Share of a flight's OK positions that may be bad, as the estimate expects.
    attitude_std_rad
        Standard deviation of roll and pitch, radians.
    detections
        Use the recording's detections too, with or without ranges. They need no identity, and
        some may be false. For the methods "batch" and "swarm".
    pixel_std_px
        Standard deviation of a detection in u and in v, pixels.
    range_offset_m
        Known offset of every range, subtracted first: an antenna delay, 0.35 m for some.
    sensors
        Sensor constants of these robots, a file that dmrl calibrate --sensors wrote.
    undistorted
        The images have no lens distortion any more, whatever the calibration says.
    copy
        Copy all topics of the input. --no-copy writes labels and positions alone and reads no
        image; dmrl merge joins them with the input.
    camera
        A robot's camera, with mount and delay, as dmrl calibrate wrote it: --camera.cf1 FILE.
    strict
        End with an error if samples, ranges or pairs of robots cannot be used. Without it, they are
        left out and counted.
    """

    method: Literal["swarm", "batch", "ekf"] = "swarm"
    preset: Literal["published-sim", "published-firmware"] = "published-sim"
    gate_m: Positive = GATE_M
    bad_share: Annotated[float, Parameter(validator=validators.Number(gt=0, lt=1))] = BAD_SHARE
    attitude_std_rad: Positive = 0.015
    detections: bool = False
    pixel_std_px: Positive = 6.0
    range_offset_m: Annotated[float, Parameter(validator=validators.Number(gt=-60, lt=60))] = 0.0
    sensors: Path | None = None
    undistorted: bool = False
    copy: bool = True
    camera: dict[str, Path] = field(default_factory=dict)
    strict: Strict = False


@dataclass(frozen=True, slots=True)
class Result:
    """One report per ordered pair, the number of labels written, and warnings."""

    pairs: "list[PairReport]"
    labels: int
    warnings: list[str]


def run(recording: In, out: Path, settings: Settings, *, workers: int = 1) -> Result:
    """Find every robot's peers from ranges and odometry, and label the images with them.

    Other messages are copied bit for bit; estimates that were there are replaced, labels from
    other sources kept.

    Parameters
    ----------
    recording
        Recording with attitude, velocity, height and ranges; or a folder of recordings.
    out
        Recording to write: all of IN, positions of peers and labels. Must not exist. For a
        folder: the folder of the outputs, under the same names.
    settings
        See `Settings`.
    workers
        Recordings of a folder, or pairs of robots of one, at a time, at most. Without it, as many
        as there are cores. Does not affect the output.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or no pair can be estimated.
    OutputError
        If ``out`` exists.
    """
    with optional_imports("label", "dmrl label"):
        from dmrl.labelling import label_flight as labelling
        from dmrl.labelling.image_labels import CameraOptions
        from dmrl.labelling.pair_estimation import PairSolver
        from dmrl.labelling.recorded_camera import read_robot_cameras
        from dmrl.recording import build_provenance

    refuse_existing(out)
    files, detections = settings.camera, settings.detections
    flight = labelling.read_label_inputs(recording, files, detections=detections)
    logs = labelling.require_pairs(
        flight, settings.range_offset_m, settings.sensors, files, detections=detections
    )
    cameras = read_robot_cameras(flight, files)
    options = CameraOptions(settings.attitude_std_rad, not settings.undistorted, cameras)
    seen = (flight, logs, options, settings.method, settings.pixel_std_px)
    bearings = labelling.read_bearings(*seen) if detections else {}
    solver = PairSolver(settings.method, settings.preset, Gate(settings.gate_m, settings.bad_share))
    made = labelling.label_flight(flight, logs, bearings, options, solver, workers, parallel_map)
    inputs = [recording, *files.values(), *filter(None, [settings.sensors])]
    origin = build_provenance("label", settings, inputs, libraries=("numpy", "scipy"))
    labelling.write_labelled(flight, out, origin, made, copy=settings.copy)
    return Result(made.reports, made.count, made.warnings)


def _show(result: Result, given: Given) -> None:
    columns = result.pairs[0].columns()
    print_table(str(given.out), columns, [pair.row() for pair in result.pairs])
    print_table("", ("labels of images",), [(result.labels,)])


command = stage_command(
    run,
    Closing(show=_show, path_key="recording"),
    folder="recording",
    warnings=lambda result, given: [f"{given.recording}: {text}" for text in result.warnings],
)
