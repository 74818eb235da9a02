"""``dmrl track``: detections over time to 3D tracks of peers."""

from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter, validators

from dmrl import topics
from dmrl.atomic_output import refuse_existing
from dmrl.errors import MissingExtra, MissingTopic, SettingError
from dmrl.geometry.camera_file import write_camera
from dmrl.geometry.frames import Camera
from dmrl.messages import message
from dmrl.pipeline.batch import is_many, over_folder
from dmrl.recording import Contents, Timed, provenance, rewrite, summary
from dmrl.terminal.arguments import AsJson, Flat, In, On, Workers
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

try:
    from dmrl.estimation.tracking.identity import Identity
    from dmrl.estimation.tracking.tracker import Track, Tracker, Tuning
    from dmrl.evaluation.tracks import CAMERAS_METADATA
    from dmrl.labelling.observer_log import SEEN, Sight, read_sight
    from dmrl.labelling.recorded_camera import camera_given, camera_of
except ModuleNotFoundError as e:
    raise MissingExtra(str(e.name), "label", "dmrl track") from e

TUNING = Tuning()
Positive = Annotated[float, Parameter(validator=validators.Number(gt=0, lt=1e6))]
Share = Annotated[float, Parameter(validator=validators.Number(gt=0, lt=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """What the tracker expects of the detector.

    Parameters
    ----------
    threshold
        Confidence from which detections are taken, 0 to 1. Without it, the recording's.
    pixel_std_px
        Error of a detection in u and in v, pixels.
    depth_std_ratio
        New error of a detection's depth in every image, over the depth.
    depth_bias_ratio
        Error of the depth that stays for seconds, over the depth.
    acceleration_std_mps2
        How much a peer changes its velocity in a second, m/s.
    detection_share
        Share of the images with a peer in view that it is detected in.
    false_per_image
        False alarms per image.
    undistorted
        The images have no lens distortion any more, whatever the calibration says.
    camera
        A robot's camera, with mount and delay, as dmrl calibrate wrote it: --camera.cf1 FILE.
    """

    threshold: Annotated[float | None, Parameter(validator=validators.Number(gte=0, lte=1))] = None
    pixel_std_px: Positive = TUNING.pixel_std_px
    depth_std_ratio: Positive = TUNING.depth_std_ratio
    depth_bias_ratio: Positive = TUNING.depth_bias_ratio
    acceleration_std_mps2: Positive = TUNING.acceleration_std_mps2
    detection_share: Share = TUNING.detection_share
    false_per_image: Positive = TUNING.false_per_image
    undistorted: bool = False
    camera: dict[str, Path] = field(default_factory=dict)

    @property
    def tuning(self) -> Tuning:
        """The tracker's, with these in it."""
        own = asdict(self)
        return Tuning(**{f.name: own[f.name] for f in fields(Tuning) if f.name in own})


@dataclass(frozen=True, slots=True)
class RobotReport:
    """What was followed from one robot."""

    robot: str
    images: int
    tracks: int
    named: int
    per_image: float


def run(recording: Path, out: Path, settings: Settings) -> list[RobotReport]:
    """Copy ``recording`` to ``out`` with tracks of what was detected.

    Other messages are copied bit for bit; tracks that were there are replaced.

    Parameters
    ----------
    recording
        With detections, calibration and attitude of one robot or more; velocity and height
        say how the robot itself moved, ranges which peer a track is.
    out
        Recording to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has no detections or no attitude.
    OutputError
        If ``out`` exists.
    """
    refuse_existing(out)
    robots = topics.robots(list(summary(recording).topics), topics.DETECTIONS)
    if not robots:
        raise MissingTopic(topics.detections("*"), summary(recording).topics, recording)
    if unknown := set(settings.camera) - set(robots):
        raise SettingError(f"--camera.{min(unknown)}: {recording} has {', '.join(robots)}")
    held = Contents(recording, *SEEN)
    cameras = {robot: _camera(held, robot, settings) for robot in robots}
    followed = {robot: _follow(held, robot, camera, settings) for robot, camera in cameras.items()}
    replaced = [topic for topic in held.topics if topics.names(topics.TRACKS, topic)]
    inputs = [recording, *settings.camera.values()]
    made = provenance("track", settings, inputs, libraries=("numpy", "scipy", "filterpy"))
    fresh = [found for found, _ in followed.values()]
    metadata = {CAMERAS_METADATA: {robot: write_camera(c) for robot, c in cameras.items()}}
    rewrite(recording, out, made, without=replaced, fresh=fresh, metadata=metadata)
    return [report for _, report in followed.values()]


def _camera(held: Contents, robot: str, settings: Settings) -> Camera:
    given = settings.camera.get(robot)
    camera = camera_given(held, robot, given) if given else camera_of(held, robot)
    if camera is None:
        raise MissingTopic(topics.calibration(robot), held.topics, held.path)
    return replace(camera, distortion=()) if settings.undistorted else camera


def _follow(
    held: Contents, robot: str, camera: Camera, settings: Settings
) -> tuple[list[Timed], RobotReport]:
    """Tracks messages of one robot, one per image, and what they hold."""
    sight = read_sight(held, robot, camera, settings.threshold)
    for warning in sight.warnings:
        say(f"{held.path}: {warning}")
    tracker, identity = Tracker(sight.camera, settings.tuning), Identity()
    made: list[Timed] = []
    seen: dict[int, str] = {}
    entries = 0
    for k in track(range(len(sight.time_ns)), f"Following from {robot}"):
        tracks = tracker.step(sight.motion(k), sight.view(k))
        names = identity.names(tracks, sight.ranges(k), sight.motion(k).dt_s)
        seen |= {t.number: names.get(t.number) or seen.get(t.number, "") for t in tracks}
        entries += len(tracks)
        made.append(_message(sight, k, tracks, names))
    images = len(sight.time_ns)
    named = sum(bool(name) for name in seen.values())
    return made, RobotReport(robot, images, len(seen), named, round(entries / max(images, 1), 3))


def _message(sight: Sight, k: int, tracks: list[Track], names: dict[int, str]) -> Timed:
    entries: list[dict[str, Any]] = []
    for one in tracks:
        numbers = [*one.position_m.tolist(), *one.velocity_mps.tolist()]
        keys = ("x", "y", "z", "vx_mps", "vy_mps", "vz_mps")
        entries.append(
            {
                "id": one.number,
                "peer": names.get(one.number, ""),
                **dict(zip(keys, numbers, strict=True)),
                "covariance": np.ravel(one.covariance).tolist(),
            }
        )
    made = message("Tracks")(frame_id=f"{sight.robot}/horizontal", tracks=entries)
    return Timed(int(sight.logged_ns[k]), topics.tracks(sight.robot), made)


DEFAULTS = Settings()


def command(
    recording: In,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Follow detected peers over time: 3D tracks with covariance.

    Parameters
    ----------
    recording
        Recording with detections, calibration and attitude; or a folder of recordings.
    out
        Recording to write: all of IN, and tracks. Must not exist. For a folder: the folder of
        what is made, under the same names.
    workers
        Of a folder: recordings at a time, at most. Without it, as many as there are cores.
        Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    if is_many(recording) or on is not None:
        over_folder("track", recording, out, settings, workers=workers, on=on, as_json=as_json)
        return
    reports = run(recording, out, settings)
    if as_json:
        print_json({"recording": str(out), "robots": [asdict(report) for report in reports]})
        return
    columns = ("robot", "images", "tracks", "named by range", "tracks per image")
    print_table(str(out), columns, [tuple(asdict(report).values()) for report in reports])
