"""Evaluate labels from the odometry of real flights of NanoBench with simulated ranges.

Run as ``python benchmarks/bench_real_odometry.py FOLDER [--seed 0] [--pairs 1,4 ...]``. FOLDER
holds the CSV files of NanoBench (arXiv 2603.09908). Each has one Crazyflie with its own state
estimate and Vicon. Two files make a pair: the second flight is turned and moved to 1 to 2.5 m
beside the first, and both robots measure ranges with calibrated noise. In every fourth pair the
second robot crashes four seconds before the end: it lies still, and its estimate diverges.
"""

import argparse
import time
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from bench_label_faults import list_times

from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.gate import GATE_M
from dmrl.estimation.model.odometry import rotation_matrix
from dmrl.estimation.model.pair import GRID_RATE_HZ, Pair, usable_ranges
from dmrl.estimation.model.position_metrics import (
    CHI2_95_OF_2,
    EvaluatedPositions,
    mahalanobis_squared,
)
from dmrl.estimation.model.status import OK
from dmrl.flight import NOISE
from dmrl.flight.sensors import draw_pair_errors
from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv
from dmrl.geometry.frames import Array
from dmrl.labelling.sensor_logs import RobotLog
from dmrl.samples.sample import Columns

NOISE_OF_RANGES = NOISE["calibrated"]
CRASH_S, EVERY = 4.0, 4
"""Time of a crash before the end of the flight, seconds; every fourth pair has one."""
RUNAWAY_MPS, RUNAWAY_RADPS, RAMP_S = 9.0, 12.0, 1.0
"""Errors of velocity and yaw rate after a crash, and the time to reach them."""
NEAR_M, FAR_M = 1.0, 2.5
AIRBORNE_M = 0.15
"""A flight begins and ends where the robot passes this height."""


@dataclass(frozen=True, slots=True)
class Flown:
    """The flight of one robot, N samples.

    Parameters
    ----------
    time_s
        (N,) times since the start of the flight.
    log
        Attitude, velocity and height estimated on board.
    place_m
        (N, 3) true positions in the world frame.
    yaw_rad
        (N,) true yaw, without jumps by a full turn.
    """

    time_s: Array
    log: RobotLog
    place_m: Array
    yaw_rad: Array


def read(path: Path) -> Flown:
    """Read a flight from a file; keep only the time in the air."""
    series = {s.topic: s for s in mapped_csv.load_content(path, Options(robot="cf")).series}
    pose = series["/cf/pose/truth"]
    place, turn = pose.fields["pose"]["position"], pose.fields["pose"]["orientation"]
    place_m = np.column_stack([place[name] for name in "xyz"])
    x, y, z, w = (np.asarray(turn[name]) for name in "xyzw")
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    up = pose.time_ns[place_m[:, 2] > AIRBORNE_M]
    at = (pose.time_ns >= up[0]) & (pose.time_ns <= up[-1])

    def crop_series(topic: str, *names: str) -> tuple[Array, Array]:
        one: Columns = series[topic]
        inside = (one.time_ns >= up[0]) & (one.time_ns <= up[-1])
        values = np.column_stack([np.asarray(one.fields[name], float) for name in names])
        return (one.time_ns[inside] - up[0]) * 1e-9, values[inside]

    log = RobotLog(
        crop_series("/cf/attitude", "roll_rad", "pitch_rad", "yaw_rate_radps"),
        crop_series("/cf/velocity", "vx_mps", "vy_mps"),
        crop_series("/cf/height", "height_m"),
    )
    return Flown((pose.time_ns[at] - up[0]) * 1e-9, log, place_m[at], yaw[at])


def add_crash(flown: Flown, at_s: float) -> Flown:
    """Add a crash to a flight: from then on the drone lies still and its estimate diverges."""
    share = np.clip((flown.time_s - at_s) / RAMP_S, 0.0, 1.0)
    down = flown.time_s >= at_s
    place, yaw = flown.place_m.copy(), flown.yaw_rad.copy()
    first = int(np.argmax(down))
    place[down, :2], yaw[down] = place[first, :2], yaw[first]
    place[:, 2] *= np.where(down, np.maximum(1 - 3 * share, 0.05), 1.0)
    times_s, attitude = flown.log.attitude
    velocity_s, velocity = flown.log.velocity
    attitude, velocity = attitude.copy(), velocity.copy()
    attitude[:, 2] += RUNAWAY_RADPS * np.clip((times_s - at_s) / RAMP_S, 0.0, 1.0)
    velocity[:, 0] += RUNAWAY_MPS * np.clip((velocity_s - at_s) / RAMP_S, 0.0, 1.0)
    log = replace(flown.log, attitude=(times_s, attitude), velocity=(velocity_s, velocity))
    return Flown(flown.time_s, log, place, yaw)


def move_aside(flown: Flown, rng: np.random.Generator) -> Flown:
    """Turn a flight about its mean position and move it 1 to 2.5 m from the origin."""
    turn, bearing = rng.uniform(-np.pi, np.pi, 2)
    middle = flown.place_m[:, :2].mean(axis=0)
    away = rng.uniform(NEAR_M, FAR_M) * np.array([np.cos(bearing), np.sin(bearing)])
    place = flown.place_m.copy()
    place[:, :2] = (place[:, :2] - middle) @ rotation_matrix(np.array([turn]))[0].T + middle + away
    return replace(flown, place_m=place, yaw_rad=flown.yaw_rad + turn)


def _at(flown: Flown, time_s: Array) -> Array:
    """Return (N, 3) true positions at some times."""
    return np.stack([np.interp(time_s, flown.time_s, c) for c in flown.place_m.T], axis=1)


def simulate_ranges(one: Flown, other: Flown, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return times and ranges of both directions, in order of time."""
    noise, (bias_m, scale) = NOISE_OF_RANGES, draw_pair_errors(rng, NOISE_OF_RANGES)
    end_s = min(one.time_s[-1], other.time_s[-1])
    time_s = np.sort(rng.uniform(0.0, end_s, int(2 * noise.ranging_rate_hz * end_s)))
    time_s = time_s[rng.random(len(time_s)) >= noise.ranging_loss]
    distance = np.linalg.norm(_at(other, time_s) - _at(one, time_s), axis=1)
    detour = rng.exponential(noise.nlos_mean_m, len(time_s))
    detour *= rng.random(len(time_s)) < noise.nlos_share
    error = bias_m + detour + rng.normal(0.0, noise.uwb_white_m, len(time_s))
    return time_s, np.maximum(scale * distance + error, 0.01)


def build_pair(one: Flown, other: Flown, rng: np.random.Generator) -> Pair:
    """Return the logs and simulated ranges of two robots as input of the estimators."""
    start_s = max(flown.log.start_s for flown in (one, other))
    end_s = min(flown.log.end_s for flown in (one, other))
    grid_s = start_s + np.arange(int((end_s - start_s) * GRID_RATE_HZ) + 1) / GRID_RATE_HZ
    time_s, range_m = simulate_ranges(one, other, rng)
    good = usable_ranges(time_s, range_m) & (time_s >= grid_s[0]) & (time_s <= grid_s[-1])
    return Pair(
        grid_s, one.log.to_track(grid_s), other.log.to_track(grid_s), time_s[good], range_m[good]
    )


def compute_truth(one: Flown, other: Flown, time_s: Array) -> Array:
    """Return (N, 2) positions of the other robot in the horizontal frame of the first, metres."""
    yaw = np.interp(time_s, one.time_s, one.yaw_rad)
    apart = (_at(other, time_s) - _at(one, time_s))[:, :2]
    return np.asarray((rotation_matrix(-yaw) @ apart[..., None])[..., 0])


def main() -> None:
    """Print a row per pair, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", nargs="*", help="for example 0,3; default: all")
    given = parser.parse_args()
    flights = [read(path) for path in sorted(given.folder.glob("*.csv"))]
    wanted = [tuple(map(int, text.split(","))) for text in given.pairs or ()]
    print("Figures of both directions together")
    print(" pair  crash   RMSE  ellipse  kept     bad  cpu-s")
    rows = []
    for number, pair in enumerate(combinations(range(len(flights)), 2)):
        if wanted and pair not in wanted:
            continue
        rng = np.random.default_rng([given.seed, number])
        one, other = flights[pair[0]], move_aside(flights[pair[1]], rng)
        crash = number % EVERY == EVERY - 1
        if crash:
            other = add_crash(other, min(one.time_s[-1], other.time_s[-1]) - CRASH_S)
        rows.append(_row(one, other, rng))
        rmse, inside, kept, bad, spent = rows[-1]
        print(
            f"{pair[0]:3d},{pair[1]} {'yes' if crash else 'no':>6}{rmse:7.3f}{inside:9.1%}"
            f"{kept:6.0%}{bad:8.2%}{spent:7.2f}",
            flush=True,
        )
    table = np.array(rows)
    print(
        f"median RMSE {np.median(table[:, 0]):.3f} m, minimum in ellipse {table[:, 1].min():.1%}, "
        f"minimum kept {table[:, 2].min():.0%}, maximum bad {table[:, 3].max():.2%}"
    )


def _row(one: Flown, other: Flown, rng: np.random.Generator) -> tuple[float, ...]:
    """Solve a pair; return RMSE, share in the ellipse, share kept, bad of kept, CPU seconds."""
    pair = build_pair(one, other, rng)
    begun = time.process_time()
    (both,) = estimate_pairs([pair])
    spent_s = time.process_time() - begun
    time_s, ways = list_times(pair), ((one, other), (other, one))
    seen = []
    for estimate, names in zip(both, ways, strict=True):
        xy, spread, status = estimate.interpolate_at(time_s)
        true = compute_truth(*names, time_s)
        distance = np.linalg.norm(true, axis=1)
        seen.append(
            EvaluatedPositions(time_s - time_s[0], xy - true, spread, distance, status == OK)
        )
    size = np.concatenate([one.error_norm_m for one in seen])
    inside = np.concatenate([mahalanobis_squared(one) <= CHI2_95_OF_2 for one in seen])
    kept = np.concatenate([one.kept for one in seen])
    bad = float((size[kept] > GATE_M).mean()) if kept.any() else 0.0
    return float(np.sqrt((size**2).mean())), float(inside.mean()), float(kept.mean()), bad, spent_s


if __name__ == "__main__":
    main()
