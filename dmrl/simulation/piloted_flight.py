"""Flights that pilots fly by what they see, as recordings that are written on the way."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dmrl import topics
from dmrl.deploy.detector import BACKEND_PACKAGES, open_detector, read_rates, select_fastest_backend
from dmrl.deploy.image_detection import DetectionOptions
from dmrl.errors import SettingError
from dmrl.flight.flight_arrays import RATE_HZ, Flight, Ranges, RobotLog
from dmrl.flight.pilot import Command, PeerTrack, Pilot, Task
from dmrl.flight.pilots import find_pilot, naming_its_package, require_leader
from dmrl.geometry.frames import (
    AIDECK_PINHOLE,
    is_inside,
    pixels_from_horizontal,
    project,
    yaw_matrix,
)
from dmrl.images.codec import decode, encode_jpeg
from dmrl.learn.pretrained import resolve_model_path
from dmrl.prediction import describe_weights
from dmrl.recording import Provenance, RecordingWriter, build_provenance
from dmrl.rendering.onboard_camera import CameraView
from dmrl.samples.flight import START_NS, merge_by_time
from dmrl.samples.sample import Sample, build_calibration, build_image, build_labels, round_samples
from dmrl.simulation import flight_samples
from dmrl.simulation.eyes import IDEAL_CONFIDENCE, Eye, IdealEye, NetworkEye
from dmrl.simulation.onboard import OnboardTracker
from dmrl.simulation.settings import NAMED_EYES
from dmrl.simulation.simulator import STEPS_PER_COMMAND, Simulation, check_command

if TYPE_CHECKING:
    from dmrl.simulation.flight_recording import FlySettings

BLOCK_SAMPLES = 100
"""Samples after which sensors and truth are written, so that a killed flight loses a second."""
TRUTH_STD_M = 1e-3
"""Standard deviation that a pilot is told for a true position."""


@dataclass(slots=True)
class Waiting:
    """Detections that have not reached the pilot yet: samples of the image, and of arrival."""

    taken: int
    ready: int
    detections: Mapping[str, Any]


@dataclass(slots=True)
class Drone:
    """One flown robot: pilot, eye, and what is between them."""

    robot: str
    pilot: Pilot
    eye: Eye | None
    tracker: OnboardTracker
    waiting: list[Waiting] = field(default_factory=list)


class FlightWriter:
    """Writes the messages of a flight as it goes on, in blocks in the order of time."""

    def __init__(self, sink: RecordingWriter, simulation: Simulation) -> None:
        self._sink, self._simulation = sink, simulation
        self._events: list[Sample] = []
        self._ranges: dict[tuple[str, str], list[Ranges]] = {}
        self._written = 0
        self.counts: Counter[str] = Counter()

    def add(self, samples: Iterator[Sample] | Sequence[Sample]) -> None:
        """Add samples to the present block."""
        self._events += samples

    def after_step(self) -> None:
        """Keep the ranges of a step, and write a block if it is full."""
        for link, ranges in self._simulation.motion.flight.ranges.items():
            self._ranges.setdefault(link, []).append(ranges)
        if self._simulation.motion.sample + 1 - self._written >= BLOCK_SAMPLES:
            self.write_block()

    def write_block(self) -> None:
        """Write all samples up to the present."""
        end, flight = self._simulation.motion.sample + 1, self._simulation.motion.flight
        part = slice(self._written, end)
        logs, yaw = {}, {}
        for robot, log in flight.robots.items():
            logs[robot] = RobotLog(*(getattr(log, name)[part] for name in RobotLog.__slots__))
            yaw[robot] = self._simulation.reckoning[robot].yaw_rad[part]
        ranges = {
            link: Ranges(
                np.concatenate([r.time_s for r in parts]),
                np.concatenate([r.range_m for r in parts]),
            )
            for link, parts in self._ranges.items()
        }
        block = Flight(logs, flight.truth, ranges, flight.clocks)
        every = round(RATE_HZ / flight_samples.TRUTH_RATE_HZ)
        moments = np.arange(-(-part.start // every) * every, end, every) / RATE_HZ
        truth = map(round_samples, flight_samples.iter_truth_streams(block, moments))
        streams = [*flight_samples.iter_sensor_streams(block, yaw), *truth]
        events = sorted(round_samples(self._events), key=lambda sample: sample.time_ns)
        for sample in merge_by_time([*streams, events]):
            self._sink.write_sample(sample)
            self.counts[topics.find_pattern(sample.topic)] += 1
        self._written, self._events, self._ranges = end, [], {}


class PilotedFlight:
    """A flight with pilots, one sample after another.

    Parameters
    ----------
    settings
        Settings of the flight.
    simulation
        The simulation, started.
    eyes
        Eye of every flown robot; None: it knows the true positions.
    writer
        Writes what happens.
    """

    def __init__(
        self,
        settings: "FlySettings",
        simulation: Simulation,
        eyes: Sequence[Eye | None],
        writer: FlightWriter,
    ) -> None:
        self._settings, self._simulation, self._writer = settings, simulation, writer
        form = find_pilot(settings.pilot)
        leader = "".join(simulation.motion.names[settings.flown : settings.flown + 1])
        require_leader(settings.pilot, leader)
        self._drones: list[Drone] = []
        for k, robot in enumerate(simulation.motion.flown):
            with naming_its_package(settings.pilot):
                pilot = form(Task(robot, k, leader, settings.distance_m))
            tracker = OnboardTracker(robot, simulation.reckoning[robot])
            self._drones.append(Drone(robot, pilot, eyes[k], tracker))
        self._commands: dict[str, Command] = {}
        self._images, self._lost = 0, np.random.default_rng((settings.seed, 999))

    def fly(self) -> Iterator[float]:
        """Fly to the end; yield the time after every step, seconds."""
        simulation = self._simulation
        if any(drone.eye for drone in self._drones):
            for drone in self._drones:
                self._writer.add([build_calibration(START_NS, drone.robot, AIDECK_PINHOLE)])
        while True:
            now = simulation.motion.sample
            while self._image_sample(self._images) == now:
                self._take_images(self._images, now)
                self._images += 1
            for drone in self._drones:
                self._deliver(drone, now)
                if now % STEPS_PER_COMMAND == 0:
                    self._command(drone, now)
            if simulation.is_over:
                break
            to_command = STEPS_PER_COMMAND - now % STEPS_PER_COMMAND
            to_image = self._image_sample(self._images) - now
            simulation.advance(self._commands, min(to_command, to_image))
            self._writer.after_step()
            yield simulation.time_s
        self._writer.write_block()

    def _image_sample(self, number: int) -> int:
        return round((number + 0.5) * RATE_HZ / self._settings.camera_rate_hz)

    def _take_images(self, number: int, now: int) -> None:
        """Take an image with every flown robot, and let its eye look."""
        vision = self._settings.vision
        ready = self._image_sample(number + vision.delay_images)
        lost = self._lost.random(len(self._drones)) < vision.lost_share
        for k, drone in enumerate(self._drones):
            if drone.eye is None:
                continue
            view = self._simulation.view(drone.robot)
            time_ns = self._log_time(drone.robot, now)
            rgb = None
            samples = []
            if self._settings.camera:
                picture = self._simulation.draw(view)
                data = encode_jpeg(picture.rgb, flight_samples.JPEG_QUALITY)
                rgb = decode(data)  # what is recorded, so that dmrl predict finds the same in it
                peers = list(flight_samples.iter_label_fields(list(view.poses), picture))
                samples = [build_image(time_ns, drone.robot, data, "jpeg")]
            else:
                peers = list(_project_labels(view))
            samples.append(build_labels(time_ns, drone.robot, peers, ["truth"]))
            look = drone.eye(view, self._simulation.time_s, rgb)
            if lost[k] or number in vision.lost_images:
                continue
            samples.append(
                Sample(time_ns, topics.DETECTIONS(drone.robot), "Detections", look.detections)
            )
            if look.grid is not None:
                samples.append(Sample(time_ns, topics.GRID(drone.robot), "GridMap", look.grid))
            self._writer.add(samples)
            drone.waiting.append(Waiting(now, ready, look.detections))

    def _deliver(self, drone: Drone, now: int) -> None:
        """Give the tracker the images that have arrived."""
        while drone.waiting and drone.waiting[0].ready <= now:
            image = drone.waiting.pop(0)
            ranges = self._simulation.observe(drone.robot).range_m
            drone.tracker.see(image.taken, image.detections, dict(ranges))
            times = self._log_time(drone.robot, image.taken), self._log_time(drone.robot, now)
            self._writer.add([drone.tracker.build_sample(*times)])

    def _command(self, drone: Drone, now: int) -> None:
        """Ask a pilot for its command."""
        seen = self._simulation.observe(drone.robot)
        if drone.eye is None:
            tracks = self._true_tracks(drone.robot)
            found = detect_tracks(tracks, seen.roll_rad, seen.pitch_rad)
            seen = replace(seen, tracks=tracks, image_age_s=0.0, detections=found)
        else:
            seen = replace(
                seen,
                tracks=drone.tracker.predict(now),
                image_age_s=drone.tracker.image_age_s(now),
                detections=drone.tracker.detections,
            )
        with naming_its_package(self._settings.pilot):
            wanted = drone.pilot.command(seen)
        command = check_command(drone.robot, wanted)
        self._commands[drone.robot] = command
        time_ns = self._log_time(drone.robot, now)
        fields = command._asdict()
        self._writer.add([Sample(time_ns, topics.COMMAND(drone.robot), "Command", fields)])

    def _true_tracks(self, robot: str) -> tuple[PeerTrack, ...]:
        """Return the true positions of all peers, as tracks."""
        simulation, found = self._simulation, []
        truth, now = simulation.motion.flight.truth, simulation.motion.sample
        turn = yaw_matrix(truth[robot].yaw[now])
        for k, peer in enumerate(simulation.motion.names):
            if peer != robot:
                position = simulation.peer_position(robot, peer)
                velocity = turn @ truth[peer].velocity[now]
                exact = TRUTH_STD_M**2 * np.eye(3)
                found.append(PeerTrack(k, peer, position, velocity, exact, 0.0))
        return tuple(found)

    def _log_time(self, robot: str, sample: int) -> int:
        clock = self._simulation.motion.flight.clocks[robot]
        return int(flight_samples.log_times(clock, np.array([sample / RATE_HZ]))[0])


def detect_tracks(
    tracks: Sequence[PeerTrack], roll_rad: float, pitch_rad: float
) -> tuple[tuple[float, float, float, float], ...]:
    """Return u, v, depth and a high confidence of every track ahead, in or out of the image."""
    places = np.array([track.position_m for track in tracks])
    roll, pitch = np.full(len(places), roll_rad), np.full(len(places), pitch_rad)
    uv_px, depth_m, _ = pixels_from_horizontal(places, roll, pitch, AIDECK_PINHOLE)
    rows = np.column_stack([uv_px, depth_m])[np.isfinite(depth_m) & (depth_m > 0)].tolist()
    return tuple((u_px, v_px, depth, IDEAL_CONFIDENCE) for u_px, v_px, depth in rows)


def _project_labels(view: CameraView) -> Iterator[dict[str, Any]]:
    """Yield the labels of peers whose centre is in the image, without rendering it."""
    for peer, pose in view.poses.items():
        uv_px, depth_m = project(pose.xyz_camera[None], AIDECK_PINHOLE.image_from_optical)
        if is_inside(uv_px, AIDECK_PINHOLE.width_px, AIDECK_PINHOLE.height_px)[0]:
            u_px, v_px = uv_px[0].tolist()
            found = {"u_px": u_px, "v_px": v_px, "depth_m": float(depth_m[0])}
            yield {"peer": peer, **found, "visible_share": 1.0, "source": "truth"}


def open_eyes(settings: "FlySettings") -> tuple[list[Eye | None], "FlySettings", Provenance]:
    """Open the eye of every flown robot.

    Returns
    -------
    eyes : list
        One for each flown robot; None: it knows the true positions.
    settings : FlySettings
        With the backend that is used.
    made : Provenance
        Of the flight.
    """
    libraries = ["numpy", "pillow", "scipy"]
    numbers = range(settings.flown)
    if str(settings.eye) in NAMED_EYES:
        made = build_provenance("fly", settings, seed=settings.seed, libraries=libraries)
        ideal = str(settings.eye) == "ideal"
        return (
            [IdealEye(settings.vision, settings.seed, k) if ideal else None for k in numbers],
            settings,
            made,
        )
    if not settings.camera:
        raise SettingError(f"--eye {settings.eye} needs images. Leave out --no-camera")
    model = resolve_model_path(Path(settings.eye))
    size_px = AIDECK_PINHOLE.width_px, AIDECK_PINHOLE.height_px
    backend = settings.backend or select_fastest_backend(model, size_px)
    settings = replace(settings, backend=backend)
    detector = open_detector(model, backend)
    detector.require_size(*size_px, "the flight's camera")
    libraries += [name for name in BACKEND_PACKAGES[backend] if name not in libraries]
    made = build_provenance("fly", settings, [model], seed=settings.seed, libraries=libraries)
    options = DetectionOptions(MIN_CONFIDENCE, MOST, 1, settings.vision.magnify)
    rates = read_rates(model)
    looks: list[Eye | None] = [NetworkEye(detector, options, rates) for _ in numbers]
    return looks, settings, describe_weights(made, model, detector)


MIN_CONFIDENCE, MOST = 0.01, 20
"""Limits on the detections of an image, as in dmrl predict."""
