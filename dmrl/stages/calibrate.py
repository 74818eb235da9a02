"""``dmrl calibrate``: cameras by a board or a flight, and sensor constants of several flights."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from dmrl.atomic_output import atomic_file, refuse_existing
from dmrl.errors import SettingError, optional_imports
from dmrl.estimation.calibration.noise import Noise
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import Count, Positive, Robot, Share
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.tables import print_table

if TYPE_CHECKING:
    from dmrl.geometry.frames import Camera
    from dmrl.labelling.sensor_file import SensorConstants

NOISE = Noise()


@dataclass(frozen=True, slots=True)
class Settings:
    """Kind of the calibration, and its inputs.

    Parameters
    ----------
    board
        Inner corners of the chessboard, columns x rows, such as 9x6: for intrinsics.
    sensors
        What flights agree on of ranges, gyroscopes and flow, in place of a camera.
    robot
        Whose camera. Without it, the only one there is.
    against
        flight: positions that the labeller estimated, or true ones.
    camera
        flight: intrinsics, mount and delay to start from, instead of the recording's.
    threshold
        flight: least confidence of a detection, 0 to 1. Without it, the recording's.
    pixel_std_px
        flight: error of a detection in u and in v, to start with; the flight says how large it is.
    attitude_std_rad
        flight: error of roll and pitch. Half of it is taken to last for the flight.
    every
        board: take every so many images of a recording.
    """

    board: str | None = None
    sensors: bool = False
    robot: Robot | None = None
    against: Literal["estimate", "truth"] = "estimate"
    camera: Path | None = None
    threshold: Share | None = None
    pixel_std_px: Positive = NOISE.pixel_std_px
    attitude_std_rad: Positive = NOISE.attitude_std_rad
    every: Count = 10


@dataclass(frozen=True, slots=True)
class Result:
    """A calibration, and figures about it by name; ``camera`` is None for sensors."""

    camera: "Camera | None"
    sensors: "SensorConstants | None"
    figures: dict[str, Any]


def run(
    sources: Annotated[list[Path], Parameter(name="SOURCE")],
    out: Path,
    settings: Settings,
    workers: int = 1,
) -> Result:
    """Calibrate cameras by boards or flights, and other sensors by several flights.

    Parameters
    ----------
    sources
        With --board, a folder of pictures or a recording; with --sensors, flights of the same
        robots; without, recordings with detections (dmrl predict) and positions of peers (dmrl
        label). Several flights are better than one: what biases a flight's positions biases its
        calibration.
    out
        TOML file to write, for --camera of label, track and convert, or for --sensors of label.
        Must not exist.
    settings
        See `Settings`.
    workers
        --sensors: flights that are solved at a time, at most. Without it, as many as there are
        cores. Does not affect the output.

    Raises
    ------
    SettingError
        If a setting is wrong, or does not suit the source.
    RecordingError, SourceError
        If the source cannot be read, or shows too little to calibrate with.
    OutputError
        If ``out`` exists.
    """
    with optional_imports("calibrate", "dmrl calibrate"):
        from dmrl.labelling.sensor_file import write_sensors
    from dmrl.geometry.camera_file import format_camera

    refuse_existing(out)
    if not settings.sensors:
        result = _calibrate_camera(sources, settings)
    elif settings.board is None:
        result = _calibrate_sensors(sources, workers)
    else:
        raise SettingError("--sensors and --board cannot be combined. Run one after the other")
    with atomic_file(out) as partial:
        text = format_camera(result.camera) if result.camera else ""
        text = write_sensors(result.sensors) if result.sensors else text
        partial.write_text(text, encoding="utf-8")
    return result


def _calibrate_camera(sources: list[Path], settings: Settings) -> Result:
    """Calibrate a camera, by a board if the settings have one, else by flights."""
    with optional_imports("calibrate", "dmrl calibrate"):
        from dmrl.labelling.calibration.board import calibrate_by_board
        from dmrl.labelling.calibration.flights import calibrate_by_flights

    if settings.board is None:
        if folder := next((source for source in sources if source.is_dir()), None):
            raise SettingError(f"{folder} is a folder. Name its board's inner corners: --board 9x6")
        camera, figures = calibrate_by_flights(
            sources,
            robot=settings.robot,
            against=settings.against,
            camera_file=settings.camera,
            threshold=settings.threshold,
            noise=Noise(settings.pixel_std_px, settings.attitude_std_rad),
        )
    elif len(sources) > 1:
        raise SettingError(f"--board takes one source, not {len(sources)}. Put all in one folder")
    else:
        camera, figures = calibrate_by_board(
            sources[0], settings.board, robot=settings.robot, every=settings.every
        )
    return Result(camera, None, figures)


def _calibrate_sensors(sources: list[Path], workers: int) -> Result:
    """Solve flights side by side, and pool their sensor constants."""
    with optional_imports("calibrate", "dmrl calibrate --sensors"):
        from dmrl.labelling.calibration.sensor_calibration import (
            pool_sensor_constants,
            solve_flight,
        )
    from dmrl.pipeline.parallel_map import parallel_map
    from dmrl.recording.provenance_inputs import refuse_duplicates
    from dmrl.terminal.progress import track

    refuse_duplicates(sources)
    flights = track(parallel_map(solve_flight, sources, workers), "Solving flights", len(sources))
    found = pool_sensor_constants(sources, flights)
    constants = [
        {**asdict(one), "of": one.of if isinstance(one.of, str) else "-".join(one.of)}
        for one in found.constants
    ]
    return Result(None, found.sensors, {"sensors": constants})


def _document(result: Result, _: Given) -> dict[str, Any]:
    made = {} if result.camera is None else {"camera": asdict(result.camera)}
    return {**made, **result.figures}


def _show(result: Result, given: Given) -> None:
    if result.sensors is not None:
        rows = result.figures["sensors"]
        print_table(str(given.out), tuple(rows[0]), [tuple(row.values()) for row in rows])
    else:
        pairs = [(name, _to_text(value)) for name, value in result.figures.items()]
        print_table(str(given.out), ("figure", "value"), pairs)


def _to_text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_to_text(one) for one in value)
    return f"{value:.3f}" if isinstance(value, float) else str(value)


command = stage_command(run, Closing(show=_show, document=_document))
