"""``dmrl track``: detections over time to 3D tracks of peers."""

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

from dmrl import topics
from dmrl.atomic_output import refuse_existing
from dmrl.errors import MissingTopic, SettingError, optional_imports
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import In, Positive, Share
from dmrl.terminal.closing import Closing

if TYPE_CHECKING:
    from dmrl.labelling.peer_tracks import RobotReport

TUNING = Tuning()


@dataclass(frozen=True, slots=True)
class Settings:
    """Assumptions about detector and peers. Rates of the detector come with the detections.

    Parameters
    ----------
    threshold
        Confidence below which detections are left out, 0 to 1. Without it, the floor of the
        detector's rates: a low confidence is weak evidence, not none.
    pixel_std_px
        Error of a detection in u and in v, pixels.
    depth_std_ratio
        New error of a detection's depth in every image, over the depth.
    depth_bias_ratio
        Error of the depth that stays for seconds, over the depth.
    speed_std_mps
        Speed of a peer in each horizontal direction, m/s.
    tilt_bias_rad
        Error of roll and pitch that stays for a flight, radians.
    undistorted
        The images have no lens distortion any more, whatever the calibration says.
    camera
        A robot's camera, with mount and delay, as dmrl calibrate wrote it: --camera.cf1 FILE.
    """

    threshold: Share | None = None
    pixel_std_px: Positive = TUNING.pixel_std_px
    depth_std_ratio: Positive = TUNING.depth_std_ratio
    depth_bias_ratio: Positive = TUNING.depth_bias_ratio
    speed_std_mps: Positive = TUNING.speed_std_mps
    tilt_bias_rad: Positive = TUNING.tilt_bias_rad
    undistorted: bool = False
    camera: dict[str, Path] = field(default_factory=dict)

    @property
    def tuning(self) -> Tuning:
        """The assumptions of the tracker, with these in place of its own."""
        own = asdict(self)
        return Tuning(**{f.name: own[f.name] for f in fields(Tuning) if f.name in own})


def run(recording: In, out: Path, settings: Settings) -> "list[RobotReport]":
    """Follow detected peers over time: 3D tracks with covariance.

    Other messages are copied bit for bit; tracks that were there are replaced. Velocity and height
    tell how the robot itself moved, ranges which peer a track is.

    Parameters
    ----------
    recording
        Recording with detections, calibration and attitude; or a folder of recordings.
    out
        Recording to write: all of IN, and tracks. Must not exist. For a folder: the folder of
        the outputs, under the same names.
    settings
        See `Settings`.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has no detections or no attitude.
    OutputError
        If ``out`` exists.
    """
    from dmrl.geometry.camera_file import format_camera
    from dmrl.recording import build_provenance, rewrite

    with optional_imports("label", "dmrl track"):
        from dmrl.evaluation.tracks import CAMERAS_METADATA
        from dmrl.labelling.flight_log import OBSERVER_TOPICS, read_flight
        from dmrl.labelling.peer_tracks import choose_camera, track_peers

    refuse_existing(out)
    flight = read_flight(recording, *OBSERVER_TOPICS, sizes_of=settings.camera)
    robots = sorted(flight.detections)
    if not robots:
        raise MissingTopic(topics.DETECTIONS("*"), flight.topics, recording)
    if unknown := set(settings.camera) - set(robots):
        raise SettingError(f"--camera.{min(unknown)}: {recording} has {', '.join(robots)}")
    cameras = {
        robot: choose_camera(
            flight, robot, settings.camera.get(robot), undistorted=settings.undistorted
        )
        for robot in robots
    }
    tracked = [
        track_peers(flight, robot, camera, settings.threshold, settings.tuning)
        for robot, camera in cameras.items()
    ]
    replaced = [topic for topic in flight.topics if topics.parse_topic(topics.TRACKS, topic)]
    inputs = [recording, *settings.camera.values()]
    made = build_provenance("track", settings, inputs, libraries=("numpy", "scipy"))
    metadata = {CAMERAS_METADATA: {robot: format_camera(c) for robot, c in cameras.items()}}
    fresh = [messages for messages, _ in tracked]
    rewrite(recording, out, made, without=replaced, fresh=fresh, metadata=metadata)
    return [report for _, report in tracked]


command = stage_command(
    run,
    Closing(
        columns=("robot", "images", "tracks", "named by range", "tracks per image"),
        path_key="recording",
        result_key="robots",
    ),
    folder="recording",
)
