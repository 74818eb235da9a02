"""``dmrl calibrate``: cameras, from a board or a flight, and what flights agree on of sensors."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter, validators
from numpy.typing import NDArray

from dmrl import topics
from dmrl.atomic_output import partial_file, refuse_existing
from dmrl.errors import MissingExtra, MissingTopic, RecordingError, SettingError, SourceError
from dmrl.geometry.camera_file import write_camera
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.guards.paths import refuse_pipes
from dmrl.images.codec import decode
from dmrl.pipeline.parallel_map import spread
from dmrl.pipeline.process_pool import cores
from dmrl.recording import Contents, read, summary
from dmrl.recording.provenance_inputs import refuse_twice
from dmrl.terminal.arguments import AsJson, Flat, Workers
from dmrl.terminal.progress import track
from dmrl.terminal.tables import print_json, print_table

try:
    from dmrl.estimation.calibration import intrinsics as board
    from dmrl.estimation.calibration.extrinsics import LEAST, Calibration, calibrate
    from dmrl.estimation.calibration.observations import Noise
    from dmrl.labelling.ground_truth import TOLD
    from dmrl.labelling.observer_log import SEEN, camera_flight
    from dmrl.labelling.recorded_camera import camera_given, camera_of
    from dmrl.labelling.sensor_calibration import Constant, agreed, solutions
    from dmrl.labelling.sensor_file import Sensors, write_sensors
except ModuleNotFoundError as e:
    raise MissingExtra(str(e.name), "calibrate", "dmrl calibrate") from e

NOISE = Noise()
PICTURES = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp")
Positive = Annotated[float, Parameter(validator=validators.Number(gt=0, lt=1e6))]


@dataclass(frozen=True, slots=True)
class Settings:
    """What is calibrated.

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
    robot: str | None = None
    against: Literal["estimate", "truth"] = "estimate"
    camera: Path | None = None
    threshold: Annotated[float | None, Parameter(validator=validators.Number(gte=0, lte=1))] = None
    pixel_std_px: Positive = NOISE.pixel_std_px
    attitude_std_rad: Positive = NOISE.attitude_std_rad
    every: Annotated[int, Parameter(validator=validators.Number(gte=1))] = 10


@dataclass(frozen=True, slots=True)
class Result:
    """What was calibrated, and figures about it by name."""

    made: Camera | Sensors
    figures: dict[str, Any]

    @property
    def camera(self) -> Camera:
        """The camera; not with ``sensors``."""
        assert isinstance(self.made, Camera)
        return self.made


def run(sources: list[Path], out: Path, settings: Settings, workers: int = 1) -> Result:
    """Write the camera of ``sources``, or what they agree on of sensors, to the TOML file ``out``.

    Parameters
    ----------
    sources
        With ``board``: a folder of pictures of a chessboard, or a recording of such images.
        With ``sensors``: flights of the same robots, two or more. Without either: recordings with
        detections and positions of peers, all by the same camera.
    out
        TOML file to write. Must not exist.
    settings
        See `Settings`.
    workers
        Flights that are solved at a time. Changes no byte.

    Raises
    ------
    SettingError
        If a setting is wrong, or does not suit the source.
    RecordingError, SourceError
        If the source cannot be read, or shows too little to calibrate with.
    OutputError
        If ``out`` exists.
    """
    refuse_existing(out)
    if settings.sensors:
        if settings.board is not None:
            raise SettingError("--sensors and --board are two calibrations. Do one after the other")
        found = _sensors(sources, workers)
    elif settings.board is None:
        if folder := next((source for source in sources if source.is_dir()), None):
            raise SettingError(f"{folder} is a folder. Name its board's inner corners: --board 9x6")
        found = _flights(sources, settings)
    elif len(sources) > 1:
        raise SettingError(f"--board takes one source, not {len(sources)}. Put all in one folder")
    else:
        found = _board(sources[0], settings)
    with partial_file(out) as partial:
        made = found.made
        text = write_camera(made) if isinstance(made, Camera) else write_sensors(made)
        partial.write_text(text, encoding="utf-8")
    return found


def _sensors(sources: list[Path], workers: int) -> Result:
    refuse_twice(sources)
    flights = track(spread(solutions, sources, workers), "Solving flights", len(sources))
    found = agreed(sources, flights)
    return Result(found.sensors, {"sensors": [_constant(one) for one in found.constants]})


def _constant(one: Constant) -> dict[str, Any]:
    of = one.of if isinstance(one.of, str) else "-".join(one.of)
    return {**asdict(one), "of": of}


def _board(source: Path, settings: Settings) -> Result:
    columns, rows = _shape(str(settings.board))
    views: list[NDArray[np.float32]] = []
    size_px: tuple[int, int] | None = None
    pictures = 0
    for name, data in _pictures(source, settings):
        rgb = decode(data, name, limits.PIXELS)
        own = rgb.shape[1], rgb.shape[0]
        if own != (size_px := size_px or own):
            raise SourceError(
                f"{name} is {own[0]}x{own[1]} px, those before it {size_px[0]}x{size_px[1]}. "
                "Calibrate with pictures of one size"
            )
        pictures += 1
        at = board.corners(np.asarray(rgb.mean(axis=2), np.uint8), columns, rows)
        views += [] if at is None else [at]
    if len(views) < board.LEAST_BOARDS or size_px is None:
        raise SourceError(
            f"{source}: a board of {columns}x{rows} inner corners in {len(views)} of {pictures} "
            f"pictures; {board.LEAST_BOARDS} are needed. Check --board, and light and focus"
            + (", or look at more: --every 1" if source.is_file() and settings.every > 1 else "")
        )
    found = board.intrinsics(views, (columns, rows), size_px)
    figures = {
        "pictures": pictures,
        "with_board": len(views),
        "rms_px": found.rms_px,
        "focal_px": [found.camera.fx_px, found.camera.fy_px],
        "focal_std_px": list(found.focal_std_px),
        "centre_px": [found.camera.cx_px, found.camera.cy_px],
        "centre_std_px": list(found.centre_std_px),
        "distortion": list(found.camera.distortion),
    }
    return Result(found.camera, figures)


def _shape(text: str) -> tuple[int, int]:
    columns, _, rows = text.partition("x")
    if not (columns.isdigit() and rows.isdigit() and int(columns) > 2 and int(rows) > 2):
        raise SettingError(f"--board {text}: give inner corners, columns x rows, such as 9x6")
    return int(columns), int(rows)


def _pictures(source: Path, settings: Settings) -> Iterator[tuple[str, bytes]]:
    """Names and bytes of the pictures of a folder, or of one robot's in a recording."""
    if source.is_dir():
        refuse_pipes(source)
        paths = sorted(p for p in source.iterdir() if p.suffix.lower() in PICTURES)
        yield from ((str(path), path.read_bytes()) for path in track(paths, "Looking for boards"))
        return
    robot = _robot(source, settings, topics.CAMERA_IMAGE)
    total = summary(source).topics[topics.camera_image(robot)].count
    stamped = track(read(source, topics.camera_image(robot)), "Looking for boards", total)
    for k, one in enumerate(stamped):
        if k % settings.every == 0:
            yield f"{source}: the image at {one.time_ns} ns", one.message.data


def _robot(source: Path, settings: Settings, pattern: str) -> str:
    held = list(summary(source).topics)
    robots = topics.robots(held, pattern)
    if settings.robot is None and len(robots) > 1:
        raise SettingError(f"{source} has {', '.join(robots)}. Name one: --robot {robots[0]}")
    robot = settings.robot or (robots[0] if robots else "*")
    if robot not in robots:
        raise MissingTopic(pattern.format(robot=robot), held, source)
    return robot


def _flights(sources: list[Path], settings: Settings) -> Result:
    robots = [_robot(source, settings, topics.DETECTIONS) for source in sources]
    positions, *more = (topics.POSITION,) if settings.against == "estimate" else TOLD
    camera = None
    flights = []
    for source, robot in zip(track(sources, "Reading"), robots, strict=True):
        held = Contents(source, *SEEN, positions, *more)
        if settings.camera:
            camera = camera_given(held, robot, settings.camera)
        camera = camera or camera_of(held, robot)
        if camera is None:
            raise MissingTopic(topics.calibration(robot), held.topics, source)
        flights.append(camera_flight(held, robot, settings.threshold, positions))
    assert camera is not None
    found = calibrate(flights, camera, Noise(settings.pixel_std_px, settings.attitude_std_rad))
    if found is None:
        raise RecordingError(
            f"{sources[0]}: fewer than {LEAST} detections of {robots[0]} lie near where its peers "
            "are. Was it the right model? Try: dmrl evaluate"
        )
    return Result(found.camera, _figures(robots[0], found))


def _figures(robot: str, found: Calibration) -> dict[str, Any]:
    return {
        "robot": robot,
        "detections": found.matched,
        "mount_deg": np.degrees(found.camera.mount_rad).tolist(),
        "mount_std_deg": np.degrees(found.mount_std_rad).tolist(),
        "delay_ms": 1e3 * found.camera.delay_s,
        "delay_std_ms": 1e3 * found.delay_std_s,
        "median_before_px": found.before_px,
        "median_after_px": found.after_px,
    }


DEFAULTS = Settings()


def command(
    sources: Annotated[list[Path], Parameter(name="SOURCE")],
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate cameras by boards or flights, other sensors by what flights agree on.

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
    workers
        --sensors: flights that are solved at a time, at most. Without it, as many as there are
        cores. Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    found = run(sources, out, settings, workers or cores())
    if as_json:
        made = {"camera": asdict(found.camera)} if isinstance(found.made, Camera) else {}
        print_json({**made, **found.figures})
    elif settings.sensors:
        rows = found.figures["sensors"]
        print_table(str(out), tuple(rows[0]), [tuple(row.values()) for row in rows])
    else:
        rows = [(k, _words(v)) for k, v in found.figures.items()]
        print_table(str(out), ("figure", "value"), rows)


def _words(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_words(one) for one in value)
    return f"{value:.3f}" if isinstance(value, float) else str(value)
