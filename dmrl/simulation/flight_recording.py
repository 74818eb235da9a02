"""Simulated flights as recordings: sensors, truth, and images with exact labels."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import permutations, tee
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter, validators

from dmrl import topics
from dmrl.atomic_output import refuse_existing
from dmrl.errors import SettingError
from dmrl.flight import NOISE, Clock, Fault, Flight, Scenario, Trajectory, Truth, simulate
from dmrl.geometry.frames import AIDECK_PINHOLE, Array
from dmrl.images.codec import encode_jpeg
from dmrl.recording import Provenance, RecordingWriter, build_provenance
from dmrl.rendering import flight_images, renderer
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.onboard_camera import ViewRenderer, WorldPose, build_view, render_sketches
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch_renderer import Sketch
from dmrl.samples import flight as samples
from dmrl.samples.flight import START_NS, Times, merge_by_time, to_nanoseconds
from dmrl.samples.sample import Sample, build_calibration, build_image, build_labels
from dmrl.simulation.settings import CameraRenderer, Preset
from dmrl.terminal.arguments import Seed
from dmrl.terminal.progress import say, track

TRUTH_RATE_HZ = 20.0
JPEG_QUALITY = 92


@dataclass(frozen=True, slots=True)
class FlySettings:
    """Robots of a flight, their motion, and the errors of their sensors.

    Parameters
    ----------
    robots
        2 to 20, named cf1, cf2, ...; cf1 leads where a trajectory has a leader.
    duration_s
        Length of the flight.
    trajectory
        How they move: in_view keeps every other robot in front of cf1, random is the paper's.
    noise
        How wrong the sensors are; docs/flights.md has the numbers.
    seed
        Another seed gives another flight.
    yaw_spread_rad
        Robots start with a yaw within plus and minus this; cf1 with 0.
    camera
        Render the images of the robots' cameras, with exact labels.
    camera_renderer
        sketch: drawn by code, each picture before another background. blender: as dmrl render
        does, with one place for the flight; sets Blender up if it is not.
    cameras_max
        The first robots, so many at most, carry a camera.
    camera_rate_hz
        Pictures per second and robot.
    faults
        Further faults: tables with kind, robot and more; docs/flights.md has them all.
    """

    robots: Annotated[int, Parameter(validator=validators.Number(gte=2, lte=20))] = 2
    duration_s: Annotated[float, Parameter(validator=validators.Number(gte=1, lte=3600))] = 100.0
    trajectory: Trajectory = "in_view"
    noise: Preset = "realistic"
    seed: Seed = 0
    yaw_spread_rad: float = 3.141592653589793
    camera: bool = False
    camera_renderer: CameraRenderer = "sketch"
    cameras_max: Annotated[int, Parameter(validator=validators.Number(gte=1))] = 20
    camera_rate_hz: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=100))] = 5.0
    faults: tuple[Fault, ...] = ()


def record_flight(out: Path, settings: FlySettings) -> dict[str, int]:
    """Simulate a flight and write it; return the number of messages by pattern of topics.

    Parameters
    ----------
    out
        Recording to write. Must not exist.
    settings
        See `FlySettings`.

    Raises
    ------
    SettingError
        If a setting is out of range.
    OutputError
        If ``out`` exists or cannot be written.
    BlenderError
        If Blender is wanted and cannot be set up, or does not start.
    """
    refuse_existing(out)
    _check(settings)
    scenario = Scenario(
        settings.robots, settings.duration_s, settings.trajectory, settings.yaw_spread_rad
    )
    flight = simulate(scenario, NOISE[settings.noise], settings.seed, settings.faults)
    _print_faults(flight)
    made = build_provenance("fly", settings, seed=settings.seed, libraries=("numpy", "pillow"))
    streams = [*_sensor_streams(flight), *_truth_streams(flight)]
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        if settings.camera:
            draw, made = _open_renderer(settings, made, stack)
            streams += _camera_streams(flight, settings, draw)
        sink = stack.enter_context(RecordingWriter(out, made))
        for sample in track(merge_by_time(streams), "Flying", _estimate_total(flight, settings)):
            sink.write_sample(sample)
            counts[_topic_pattern(sample.topic)] += 1
    return dict(sorted(counts.items()))


def _print_faults(flight: Flight) -> None:
    """Print every fault with its times, in seconds from the start."""
    end_s = float(next(iter(flight.truth.values())).time_s[-1])
    for event in flight.faults:
        windows = [f"{start:.1f}-{min(end, end_s):.1f}" for start, end in event.windows_s.tolist()]
        say(f"{event.fault}: {', '.join(windows)} s")


def _open_renderer(
    settings: FlySettings, made: Provenance, stack: ExitStack
) -> tuple[ViewRenderer, Provenance]:
    """Return the renderer, closed with the stack, and the provenance with its version."""
    if settings.camera_renderer == "sketch":
        return render_sketches, made
    blender = stack.enter_context(renderer.Renderer(ensure_environment(say), renderer.RobotModel()))
    made = replace(made, libraries={**made.libraries, "blender": blender.version})
    return flight_images.FlightRenderer(blender, settings.seed), made


def _check(settings: FlySettings) -> None:
    if settings.seed < 0 or settings.cameras_max < 1:
        raise SettingError("--seed must be 0 or more, cameras_max 1 or more. Change them")
    if not 0 < settings.camera_rate_hz <= 100:
        raise SettingError(f"--camera-rate-hz {settings.camera_rate_hz}: choose over 0, to 100")


def _topic_pattern(topic: str) -> str:
    row = topics.find_topic(topic)
    return topic if row is None else row.pattern


def _estimate_total(flight: Flight, settings: FlySettings) -> int:
    """Estimate the number of samples, to within a few."""
    robots = len(flight.robots)
    logs = sum(3 * len(log.time_s) for log in flight.robots.values())
    ranged = sum(len(ranges.time_s) for ranges in flight.ranges.values())
    truth = int(settings.duration_s * TRUTH_RATE_HZ) * (robots * (robots - 1) + 1)
    pictures = (
        2 * min(robots, settings.cameras_max) * int(settings.duration_s * settings.camera_rate_hz)
    )
    return logs + ranged + truth + settings.camera * pictures


def _log_times(clock: Clock, true_time_s: Array) -> Times:
    """Return the log times of true times: those of the robot's own clock."""
    return START_NS + to_nanoseconds(clock.to_clock_time(true_time_s))


def _sensor_streams(flight: Flight) -> Iterator[Iterator[Sample]]:
    for robot, log in flight.robots.items():
        columns = {name: getattr(log, name) for name in samples.LOG_COLUMNS}
        yield samples.iter_robot_log(robot, START_NS + to_nanoseconds(log.time_s), columns)
    for (robot, peer), ranges in flight.ranges.items():
        time_ns = START_NS + to_nanoseconds(ranges.time_s)
        yield samples.iter_ranges(robot, peer, time_ns, ranges.range_m)


def _truth_streams(flight: Flight) -> Iterator[Iterator[Sample]]:
    end_s = next(iter(flight.truth.values())).time_s[-1]
    time_s = np.arange(0.0, end_s, 1.0 / TRUTH_RATE_HZ)
    for robot, peer in permutations(flight.truth, 2):
        yield _peer_truth(flight, robot, peer, time_s)
    yield (_transforms(flight, float(moment)) for moment in time_s)


def _peer_truth(flight: Flight, robot: str, peer: str, true_time_s: Array) -> Iterator[Sample]:
    for part in samples.iter_slices(len(true_time_s)):
        time_s = true_time_s[part]
        xyz = flight.peer_in_horizontal(robot, peer, time_s)
        yield from samples.iter_truth(robot, peer, _log_times(flight.clocks[robot], time_s), xyz)


def _transforms(flight: Flight, true_time_s: float) -> Sample:
    """Return every robot's frames, on true time."""
    bodies = {robot: _body_at(truth, true_time_s) for robot, truth in flight.truth.items()}
    attitudes = {
        robot: samples.RobotPose(b.xyz_world, b.yaw_rad, b.roll_rad, b.pitch_rad)
        for robot, b in bodies.items()
    }
    time_ns = int(_log_times(Clock(), np.array([true_time_s]))[0])
    return samples.build_transforms(time_ns, attitudes)


def _body_at(truth: Truth, true_time_s: float) -> WorldPose:
    at = np.array([true_time_s])
    return WorldPose(
        truth.position_at(at)[0],
        float(truth.yaw_at(at)[0]),
        float(np.interp(true_time_s, truth.time_s, truth.roll)),
        float(np.interp(true_time_s, truth.time_s, truth.pitch)),
    )


def _camera_streams(
    flight: Flight, settings: FlySettings, draw: ViewRenderer
) -> Iterator[Iterator[Sample]]:
    for k, robot in enumerate(list(flight.truth)[: settings.cameras_max]):
        yield _camera_stream(flight, robot, k, settings, draw)


def _camera_stream(
    flight: Flight, robot: str, number: int, settings: FlySettings, draw: ViewRenderer
) -> Iterator[Sample]:
    """Yield the calibration of a robot's camera, then its images, each with its labels."""
    period_s = 1.0 / settings.camera_rate_hz
    time_s = np.arange(period_s / 2, settings.duration_s, period_s)
    yield build_calibration(START_NS, robot, AIDECK_PINHOLE)

    def bodies(moment_s: float) -> dict[str, WorldPose]:
        return {name: _body_at(truth, moment_s) for name, truth in flight.truth.items()}

    views = (
        build_view(bodies, robot, moment_s, (settings.seed, number, k))
        for k, moment_s in enumerate(time_s.tolist())
    )
    seen_in, drawn = tee(views)  # which holds what is drawn ahead of what is written
    stamps = _log_times(flight.clocks[robot], time_s).tolist()
    for time_ns, seen, picture in zip(stamps, seen_in, draw(AIDECK_PINHOLE, drawn), strict=True):
        yield build_image(time_ns, robot, encode_jpeg(picture.rgb, JPEG_QUALITY), "jpeg")
        yield build_labels(
            time_ns, robot, list(_label_fields(list(seen.poses), picture)), ["truth"]
        )


def _label_fields(peers: Sequence[str], picture: Sketch | Shot) -> Iterator[dict[str, Any]]:
    for k, peer in enumerate(peers):
        box = picture.box_px[k]
        yield {
            "peer": peer,
            "u_px": picture.uv_px[k, 0],
            "v_px": picture.uv_px[k, 1],
            "depth_m": picture.depth_m[k],
            "box_px": [] if np.isnan(box).any() else box.tolist(),
            "visible_share": float(picture.visible_share[k]),
            "source": "truth",
        }
