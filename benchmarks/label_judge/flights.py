"""Simulated flights of two robots as arrays, which faults may change, and their recordings."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.flight import NOISE, TRAJECTORIES, Fault, Flight, Scenario, simulate
from dmrl.flight.bound import compute_bound
from dmrl.flight.trajectories import Motion, Start
from dmrl.geometry.frames import AIDECK_PINHOLE, pixels_from_horizontal
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.samples.flight import LOG_COLUMNS, START_NS
from dmrl.samples.sample import build_calibration
from dmrl.simulation.flight_recording import FlySettings

Array = NDArray[np.float64]
Pair = tuple[str, str]
BOTH: tuple[Pair, Pair] = (("cf1", "cf2"), ("cf2", "cf1"))
MOTIONS = ("in_view", "room", "random")
HOPS = "hops"
"""A trajectory that only this benchmark has: rests and hops in a room of 4 x 4 m, up to 4 m/s."""
TRUTH_HZ = 20.0


def hop(rng: np.random.Generator, start: Start, _leader: Motion | None) -> Motion:
    """Return the motion of a robot that rests, and hops and turns along minimum-jerk paths."""
    time_s = np.arange(start.samples) / 100
    position, velocity = np.zeros((2, start.samples), complex)
    yaw_rate = np.zeros(start.samples)
    place, begins_s = complex(*rng.uniform(-1.8, 1.8, 2)), 0.0
    while begins_s < time_s[-1]:
        goal, rest_s = complex(*rng.uniform(-1.8, 1.8, 2)), rng.uniform(0.0, 2.0)
        lasts_s = max(abs(goal - place) / rng.uniform(0.8, 2.2), 0.8)
        at = np.clip((time_s - begins_s - rest_s) / lasts_s, 0.0, 1.0)
        here = (time_s >= begins_s) & (time_s < begins_s + rest_s + lasts_s)
        way = goal - place
        position[here] = (place + way * (10 * at**3 - 15 * at**4 + 6 * at**5))[here]
        velocity[here] = (way * 30 * at**2 * (1 - at) ** 2 / lasts_s)[here]
        yaw_rate[here] = (rng.uniform(-1, 1) * 30 * at**2 * (1 - at) ** 2 / lasts_s)[here]
        place, begins_s = goal, begins_s + rest_s + lasts_s
    yaw = start.yaw_rad + np.concatenate([[0.0], np.cumsum(yaw_rate[1:] + yaw_rate[:-1]) / 200])
    return Motion(position, velocity, yaw, yaw_rate)


TRAJECTORIES[HOPS] = (hop, hop)  # type: ignore[index]


@dataclass
class Logs:
    """Contents of a recording; all times are on the clocks of the robots, seconds.

    Parameters
    ----------
    robots
        By robot: ``time_s`` and the columns of its log, (N,) each; NaN during dropouts.
    ranges
        By (measuring robot, answering robot): (2, M) times and ranges.
    truth
        By (observer, peer): (N, 4) times and x, y, z in the observer's horizontal frame.
    bound
        By (observer, peer): (N, 2, 2) smallest possible covariances at the times of the truth.
        Empty with cameras.
    flight
        The simulated flight, for faults that depend on the true motion.
    detections
        By robot: times of images, and for each the rows (u, v, depth, confidence).
    """

    robots: dict[str, dict[str, Array]]
    ranges: dict[Pair, Array]
    truth: dict[Pair, Array]
    bound: dict[Pair, Array]
    flight: Flight
    detections: dict[str, tuple[Array, list[Array]]] = field(default_factory=dict)

    @property
    def end_s(self) -> float:
        """Return the length of the flight, seconds."""
        return float(self.flight.truth["cf1"].time_s[-1])


@dataclass(frozen=True)
class Base:
    """A flight without an injected fault.

    Parameters
    ----------
    motion, noise, duration_s, seed
        As in `dmrl fly`.
    faults
        Landings and crashes, which the simulator flies.
    """

    motion: str
    noise: str
    duration_s: float
    seed: int
    faults: tuple[Fault, ...] = ()

    @property
    def settings(self) -> FlySettings:
        """Return the settings of `dmrl fly` for this flight."""
        return FlySettings(
            duration_s=self.duration_s,
            trajectory=self.motion,  # type: ignore[arg-type]
            noise=self.noise,  # type: ignore[arg-type]
            seed=self.seed,
            faults=self.faults,
        )


@cache
def _fly(base: Base) -> tuple[Flight, dict[Pair, Array], dict[Pair, Array]]:
    """Simulate a flight; return it with true positions and bounds of both pairs over time."""
    settings, noise = base.settings, NOISE[base.noise]
    scenario = Scenario(2, base.duration_s, settings.trajectory, settings.yaw_spread_rad)
    flight = simulate(scenario, noise, base.seed, base.faults)
    bound = compute_bound(flight, noise, scenario.yaw_spread_rad)
    time_s = np.arange(0.0, flight.truth["cf1"].time_s[-1], 1 / TRUTH_HZ)
    truth = {
        pair: np.column_stack(
            [
                flight.clocks[pair[0]].to_clock_time(time_s),
                flight.peer_in_horizontal(*pair, time_s),
            ]
        )
        for pair in BOTH
    }
    return flight, truth, {pair: bound.interpolate_at(pair, time_s) for pair in BOTH}


def fly(base: Base) -> Logs:
    """Simulate a flight once; return new arrays each time, which the caller may change."""
    flight, truth, bound = _fly(base)
    robots = {
        name: {key: getattr(log, key).copy() for key in ("time_s", *LOG_COLUMNS)}
        for name, log in flight.robots.items()
    }
    ranges = {link: np.stack([r.time_s, r.range_m]) for link, r in flight.ranges.items()}
    copied = {pair: rows.copy() for pair, rows in truth.items()}
    return Logs(robots, ranges, copied, bound, flight)


def write(logs: Logs, base: Base, what: Mapping[str, Any], path: Path) -> None:
    """Write a recording like that of `dmrl fly`, and the bound beside it (.npz)."""
    settings = {**asdict(base.settings), "injected": dict(what)}
    with RecordingWriter(path, Provenance("fly", settings, base.seed), recipe="") as sink:
        for robot, columns in logs.robots.items():
            _write_log(sink, robot, columns)
        for (robot, peer), (time_s, range_m) in logs.ranges.items():
            _write_columns(sink, topics.RANGE(robot, peer), "UwbRange", time_s, range_m=range_m)
        for (robot, peer), rows in logs.truth.items():
            time_s, x, y, z = rows.T
            exact = np.zeros((len(rows), 9))
            values = {"x": x, "y": y, "z": z, "covariance": exact}
            _write_columns(sink, topics.TRUTH(robot, peer), "PeerPosition", time_s, **values)
        for robot, (time_s, found) in logs.detections.items():
            sink.write_sample(build_calibration(START_NS, robot, AIDECK_PINHOLE))
            for at, rows in zip(time_s.tolist(), found, strict=True):
                _write_detections(sink, robot, at, rows)
    bounds = {f"{a}-{b}": rows for (a, b), rows in logs.bound.items()}
    times = {f"{a}-{b}-s": rows[:, 0] for (a, b), rows in logs.truth.items()}
    np.savez_compressed(path.with_suffix(".npz"), **bounds, **times)


def _write_log(sink: RecordingWriter, robot: str, columns: Mapping[str, Array]) -> None:
    """Write attitude, velocity and height of a robot; integrate yaw where it is not logged."""
    time_s, rate = columns["time_s"], columns["yaw_rate_radps"]
    known = np.isfinite(rate)
    rate = np.interp(time_s, time_s[known], rate[known]) if known.any() else np.zeros(len(rate))
    yaw = np.concatenate([[0.0], np.cumsum(np.diff(time_s) * (rate[1:] + rate[:-1]) / 2)])
    attitude = {key: columns[key] for key in LOG_COLUMNS[:3]}
    _write_columns(
        sink, topics.ATTITUDE(robot), "Attitude", time_s, yaw_rad=columns.get("yaw_rad", yaw),
        **attitude,
    )  # fmt: skip
    velocity = {key: columns[key] for key in LOG_COLUMNS[3:5]}
    _write_columns(sink, topics.VELOCITY(robot), "Velocity", time_s, **velocity)
    height_m = columns[LOG_COLUMNS[5]]
    _write_columns(sink, topics.HEIGHT(robot), "Height", time_s, height_m=height_m)


def _write_columns(
    sink: RecordingWriter, topic: str, message: str, time_s: Array, **fields: Array
) -> None:
    """Write the rows without NaN, in order of time."""
    if not len(time_s):
        return
    good = np.all([np.isfinite(v).reshape(len(time_s), -1).all(axis=1) for v in fields.values()], 0)
    order = np.argsort(time_s[good], kind="stable")
    log_ns = START_NS + np.rint(time_s[good][order] * 1e9).astype(np.int64)
    columns = {name: np.asarray(values)[good][order] for name, values in fields.items()}
    sink.write_columns(topic, message_class(message), log_ns, columns)


def _write_detections(sink: RecordingWriter, robot: str, at_s: float, rows: Array) -> None:
    """Write the detections (N, 4) of an image."""
    names = ("u_px", "v_px", "depth_m", "confidence")
    found = [dict(zip(names, row, strict=True)) for row in rows.tolist()]
    message = message_class("Detections")(threshold=0.3, detections=found)
    sink.write(START_NS + round(at_s * 1e9), topics.DETECTIONS(robot), message)


@dataclass(frozen=True)
class Eye:
    """Errors of the detectors of the robots, which process 10 images per second.

    Parameters
    ----------
    pixel_px, depth_share, missed
        Standard deviation of u and v, of the relative depth, and the share of missed peers.
    wrong
        Share of images with a false detection.
    lasting_share, lasting_s
        Standard deviation and time constant of a correlated relative depth error.
    unseen_share
        Share of spans of ``lasting_s`` in which the peer is never found.
    too_far
        Constant relative error of all depths.
    """

    pixel_px: float = 2.0
    depth_share: float = 0.1
    missed: float = 0.15
    wrong: float = 0.0
    lasting_share: float = 0.0
    lasting_s: float = 3.0
    unseen_share: float = 0.0
    too_far: float = 0.0


def look(logs: Logs, eye: Eye, rng: np.random.Generator) -> Logs:
    """Add simulated detections of the camera of every robot."""
    flight = logs.flight
    for robot, peer in BOTH:
        true_s = np.arange(0.05, logs.end_s, 0.1)
        truth = flight.truth[robot]
        roll, pitch = (np.interp(true_s, truth.time_s, a) for a in (truth.roll, truth.pitch))
        place = flight.peer_in_horizontal(robot, peer, true_s)
        uv, depth, _ = pixels_from_horizontal(place, roll, pitch, AIDECK_PINHOLE)
        size = np.array([AIDECK_PINHOLE.width_px, AIDECK_PINHOLE.height_px])
        shown = (depth > 0.1) & (depth < 5.0) & ((uv > 0) & (uv < size)).all(axis=1)
        shown &= rng.random(len(uv)) >= eye.missed
        shown &= draw_spans(rng, true_s, eye.lasting_s) >= eye.unseen_share
        lasting = eye.lasting_share * draw_walk(rng, true_s, eye.lasting_s)
        noisy = uv + rng.normal(0.0, eye.pixel_px, uv.shape)
        scatter = rng.normal(0.0, eye.depth_share, len(depth))
        away = (1 + eye.too_far) * depth * np.exp(scatter + lasting)
        found = []
        for k in range(len(true_s)):
            rows = [[*noisy[k], away[k], 0.8]] if shown[k] else []
            if rng.random() < eye.wrong:
                far = float(np.exp(rng.uniform(np.log(0.5), np.log(4.0))))
                rows.append([*(rng.random(2) * size), far, 0.7])
            found.append(np.reshape(np.array(rows, float), (-1, 4)))
        logs.detections[robot] = (flight.clocks[robot].to_clock_time(true_s), found)
    return logs


def draw_walk(rng: np.random.Generator, time_s: Array, tau_s: float) -> Array:
    """Draw (N,) samples of a stationary Ornstein-Uhlenbeck process of unit variance."""
    keep = np.exp(-(time_s[1] - time_s[0]) / tau_s)
    out = rng.normal(0.0, 1.0, len(time_s))
    for k in range(1, len(out)):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * out[k]
    return np.asarray(out)


def draw_spans(rng: np.random.Generator, time_s: Array, length_s: float) -> Array:
    """Draw (N,) uniform numbers in (0, 1) that are constant over spans of ``length_s``."""
    index = ((time_s - time_s[0]) / length_s).astype(int)
    return np.asarray(rng.random(index[-1] + 1)[index])
