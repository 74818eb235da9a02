"""Simulated flights as recordings: sensors, truth, and images with exact labels."""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from itertools import tee
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter, validators

from dmrl import topics
from dmrl.atomic_output import refuse_existing
from dmrl.deploy.backend_names import BackendName
from dmrl.errors import SettingError, optional_imports
from dmrl.flight import NOISE, Fault, Flight, Scenario, Trajectory, simulate
from dmrl.flight.flight_arrays import RATE_HZ
from dmrl.geometry.frames import AIDECK_PINHOLE
from dmrl.images.codec import encode_jpeg
from dmrl.recording import Provenance, RecordingWriter, build_provenance
from dmrl.rendering import flight_images, renderer
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.onboard_camera import ViewRenderer, build_view, render_sketches
from dmrl.samples.flight import START_NS, RobotPose, merge_by_time
from dmrl.samples.sample import Sample, build_calibration, build_image, build_labels, round_samples
from dmrl.simulation.flight_samples import (
    JPEG_QUALITY,
    TRUTH_RATE_HZ,
    body_at,
    iter_label_fields,
    iter_sensor_streams,
    iter_truth_streams,
    log_times,
)
from dmrl.simulation.settings import NAMED_EYES, CameraRenderer, Eye, Preset, Vision
from dmrl.simulation.simulator import STEPS_PER_COMMAND, Simulation
from dmrl.terminal.arguments import Seed
from dmrl.terminal.progress import say, track

DEFAULT_VISION = Vision()


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
    place
        Number of the room and its light, and of the camera, for images in one place. Without it,
        the seed's.
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
    pilot
        Who flies the first robots: follow, keep_apart, formation or a plug-in's. Empty: nobody,
        they fly their trajectory.
    flown
        The pilot flies so many robots; the next one is their leader.
    distance_m
        Distance that the pilot keeps.
    eye
        What the pilot sees: truth, the true positions; ideal, a camera without alarms; or a model.
    backend
        What computes the model. Without it, the fastest float one.
    vision
        Delay and losses of images, and the errors of an ideal eye.
    """

    robots: Annotated[int, Parameter(validator=validators.Number(gte=2, lte=20))] = 2
    duration_s: Annotated[float, Parameter(validator=validators.Number(gte=1, lte=3600))] = 100.0
    trajectory: Trajectory = "in_view"
    noise: Preset = "realistic"
    seed: Seed = 0
    place: Seed | None = None
    yaw_spread_rad: float = 3.141592653589793
    camera: bool = False
    camera_renderer: CameraRenderer = "sketch"
    cameras_max: Annotated[int, Parameter(validator=validators.Number(gte=1))] = 20
    camera_rate_hz: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=100))] = 5.0
    faults: tuple[Fault, ...] = ()
    pilot: str = ""
    flown: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=20))] = 1
    distance_m: Annotated[float, Parameter(validator=validators.Number(gt=0.2, lte=3))] = 0.7
    eye: Eye = "truth"
    backend: BackendName | None = None
    vision: Vision = DEFAULT_VISION


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
    if settings.pilot:
        return _record_piloted(out, settings)
    scenario = Scenario(
        settings.robots, settings.duration_s, settings.trajectory, settings.yaw_spread_rad
    )
    flight = simulate(scenario, NOISE[settings.noise], settings.seed, settings.faults)
    _print_faults(flight)
    made = build_provenance("fly", settings, seed=settings.seed, libraries=("numpy", "pillow"))
    time_s = np.arange(0.0, scenario.last_s, 1.0 / TRUTH_RATE_HZ)
    streams = [
        *iter_sensor_streams(flight),
        *map(round_samples, iter_truth_streams(flight, time_s)),
    ]
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        if settings.camera:
            draw, made = _open_renderer(settings, made, stack)
            for k, robot in enumerate([*flight.truth][: settings.cameras_max]):
                streams.append(round_samples(_camera_stream(flight, robot, k, settings, draw)))
        sink = stack.enter_context(RecordingWriter(out, made))
        for sample in track(merge_by_time(streams), "Flying", _estimate_total(flight, settings)):
            sink.write_sample(sample)
            counts[topics.find_pattern(sample.topic)] += 1
    return dict(sorted(counts.items()))


def _record_piloted(out: Path, settings: FlySettings) -> dict[str, int]:
    """Record a flight of pilots."""
    with optional_imports("label", "a pilot"):
        from dmrl.simulation import piloted_flight as piloted  # noqa: PLC0415 - has filterpy

    eyes, settings, made = piloted.open_eyes(settings)
    with Simulation(
        settings.robots,
        flown=settings.flown,
        trajectory=settings.trajectory,
        distance_m=settings.distance_m,
        duration_s=settings.duration_s,
        noise=settings.noise,
        camera_renderer=settings.camera_renderer,
        faults=settings.faults,
    ) as simulation:
        simulation.reset(settings.seed, settings.place)
        _print_faults(simulation.motion.flight)
        if settings.camera and settings.camera_renderer == "blender" and eyes[0] is not None:
            simulation.start_blender()
            blender = {"blender": simulation.blender_version}
            made = replace(made, libraries={**made.libraries, **blender})
        with RecordingWriter(out, made) as sink:
            writer = piloted.FlightWriter(sink, simulation)
            flight = piloted.PilotedFlight(settings, simulation, eyes, writer)
            steps = int(settings.duration_s * RATE_HZ / STEPS_PER_COMMAND)
            for _ in track(flight.fly(), "Flying", steps):
                pass
    return dict(sorted(writer.counts.items()))


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
    return flight_images.FlightRenderer(blender, _choose_place(settings)), made


def _choose_place(settings: FlySettings) -> int:
    return settings.seed if settings.place is None else settings.place


PILOT_SETTINGS = ("flown", "distance_m", "eye", "backend", "vision")
"""Settings that only a pilot uses."""
SCRIPT_SETTINGS = ("cameras_max", "yaw_spread_rad")
"""Settings that flights of a pilot do not use."""
LINK_SETTINGS = ("delay_images", "lost_share", "lost_images")
"""Settings of ``vision`` that all eyes with a camera use."""
NETWORK_SETTINGS = ("magnify",)
"""Settings of ``vision`` that networks use; an ideal eye uses the others."""


def _iter_idle(settings: FlySettings) -> Iterator[tuple[str, str]]:
    """Yield every setting that was given and has no effect, and why."""
    if not settings.pilot:
        yield from _iter_given(
            settings, PILOT_SETTINGS, "without a pilot. Name one: --pilot follow"
        )
        return
    yield from _iter_given(settings, SCRIPT_SETTINGS, "with a pilot. Leave it out")
    eye = str(settings.eye)
    if eye in NAMED_EYES:
        yield from _iter_given(settings, ("backend",), f"with --eye {eye}. Leave it out")
    used = {
        "truth": (),
        "ideal": [one.name for one in fields(Vision) if one.name not in NETWORK_SETTINGS],
    }.get(eye, (*LINK_SETTINGS, *NETWORK_SETTINGS))
    idle = [one.name for one in fields(Vision) if one.name not in used]
    for key, why in _iter_given(settings.vision, idle, f"with --eye {eye}. Leave it out"):
        yield f"vision.{key}", why


def _iter_given(
    settings: FlySettings | Vision, names: Iterable[str], why: str
) -> Iterator[tuple[str, str]]:
    plain = type(settings)()
    yield from ((n, why) for n in names if getattr(settings, n) != getattr(plain, n))


def _check(settings: FlySettings) -> None:
    for name, why in _iter_idle(settings):
        raise SettingError(f"{name} has no effect {why}")
    if not 1 <= settings.duration_s <= 3600:  # the validator of the flag lets NaN pass
        raise SettingError(f"--duration-s {settings.duration_s}: choose 1 to 3600")
    if settings.seed < 0:
        raise SettingError(f"--seed {settings.seed}: choose 0 or more")
    if settings.cameras_max < 1:
        raise SettingError(f"cameras_max = {settings.cameras_max}: choose 1 or more")
    if not 0 < settings.camera_rate_hz <= 100:
        raise SettingError(f"--camera-rate-hz {settings.camera_rate_hz}: choose over 0, to 100")


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


def _camera_stream(
    flight: Flight, robot: str, number: int, settings: FlySettings, draw: ViewRenderer
) -> Iterator[Sample]:
    """Yield the calibration of a robot's camera, then its images, each with its labels."""
    period_s = 1.0 / settings.camera_rate_hz
    time_s = np.arange(period_s / 2, settings.duration_s, period_s)
    yield build_calibration(START_NS, robot, AIDECK_PINHOLE)

    def bodies(moment_s: float) -> dict[str, RobotPose]:
        return {name: body_at(truth, moment_s) for name, truth in flight.truth.items()}

    views = (
        build_view(bodies, robot, moment_s, (_choose_place(settings), number, k))
        for k, moment_s in enumerate(time_s.tolist())
    )
    seen_in, drawn = tee(views)  # which holds what is drawn ahead of what is written
    stamps = log_times(flight.clocks[robot], time_s).tolist()
    for time_ns, seen, picture in zip(stamps, seen_in, draw(AIDECK_PINHOLE, drawn), strict=True):
        yield build_image(time_ns, robot, encode_jpeg(picture.rgb, JPEG_QUALITY), "jpeg")
        yield build_labels(
            time_ns, robot, list(iter_label_fields(list(seen.poses), picture)), ["truth"]
        )
