"""Compare labels from ranges alone with labels from ranges and camera detections.

Run as ``python benchmarks/bench_label_detections.py [--flights 6] [--first-seed 0] [--only CASE]``.
The flights are simulated like those of `dmrl fly`. Every robot has a detector like a small network,
with 10 images per second. It misses 15 % of the peers in view. Its noise is 1.5 px and 10 % of the
distance, 7 % of the images have a false detection, and detections do not name the robot. Every
pair is solved without and with the detections. The gate of `dmrl label` decides which positions
are kept.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from bench_label_faults import build_pair, list_times
from fault_cases import CASES as FAULTS

from dmrl.estimation.flight.data_association import resolve_conflicts
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.model.position_metrics import (
    CHI2_95_OF_2,
    MAX_GOOD_ERROR_M,
    EvaluatedPositions,
    mahalanobis_squared,
)
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.estimate import Estimate
from dmrl.flight import NOISE, Flight, Scenario, Trajectory, simulate
from dmrl.geometry.frames import AIDECK, Array, pixels_from_horizontal
from dmrl.labelling.camera_bearings import add_bearings, detections_to_bearings
from dmrl.labelling.observer_log import ObserverLog

IMAGES_HZ = 10.0
PIXEL_STD_PX, DISTANCE_RATIO, MISSED, FARTHEST_M = 1.5, 0.1, 0.15, 5.0
SAID_PX, ATTITUDE_STD_RAD = 3.0, 0.015
"""The --pixel-std-px given to `dmrl label`, and its standard deviation of attitudes."""
SETTLE_S = 5.0
Names = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of flight.

    Parameters
    ----------
    trajectory, duration_s, robots
        As in `dmrl fly`.
    fault
        Name of a case in `fault_cases`.
    wrong
        Share of images with a false detection.
    """

    trajectory: Trajectory
    duration_s: float = 60.0
    robots: int = 2
    fault: str = "none"
    wrong: float = 0.07


CASES = {
    "in view": Case("in_view"),
    "in view, 50 % wrong": Case("in_view", wrong=0.5),
    "in view, three robots": Case("in_view", robots=3),
    "random": Case("random"),
    "15 s": Case("in_view", 15.0),
    "no ranges for 30 s": Case("in_view", 100.0, fault="no ranges for 30 s"),
    "flow stuck for 10 s": Case("in_view", 100.0, fault="flow stuck for 10 s"),
    "observer at rest": Case("observer_static"),
    "both at rest": Case("both_static"),
    "three at rest": Case("both_static", robots=3),
    "both the same way": Case("parallel"),
    "peer at rest": Case("peer_static"),
}


def simulate_detections(flight: Flight, wrong: float, seed: int) -> dict[str, ObserverLog]:
    """Return simulated detections of every robot's camera."""
    rng = np.random.default_rng(seed + 10_000)
    return {robot: _detect(flight, robot, wrong, rng) for robot in flight.robots}


def _detect(flight: Flight, robot: str, wrong: float, rng: np.random.Generator) -> ObserverLog:
    """Simulate detections of all peers by a robot, with misses and false detections."""
    log, truth, clock = flight.robots[robot], flight.truth[robot], flight.clocks[robot]
    time_s = np.arange(log.time_s[0] + 0.05, log.time_s[-1], 1 / IMAGES_HZ)
    true_s = clock.to_true_time(time_s)
    roll, pitch = (np.interp(true_s, truth.time_s, angle) for angle in (truth.roll, truth.pitch))
    found: list[list[list[float]]] = [[] for _ in time_s]
    size = np.array([AIDECK.width_px, AIDECK.height_px])
    for peer in flight.robots:
        if peer == robot:
            continue
        place = flight.peer_in_horizontal(robot, peer, true_s)
        uv, depth_m, _ = pixels_from_horizontal(place, roll, pitch, AIDECK)
        shown = (depth_m > 0.1) & (depth_m < FARTHEST_M) & ((uv > 0) & (uv < size)).all(axis=1)
        uv = uv + PIXEL_STD_PX * rng.standard_normal(uv.shape)
        depth_m = depth_m * np.exp(DISTANCE_RATIO * rng.standard_normal(len(depth_m)))
        for k in np.flatnonzero(shown & (rng.random(len(uv)) >= MISSED)):
            found[k].append([*uv[k], depth_m[k], DISTANCE_RATIO * depth_m[k]])
    for k in np.flatnonzero(rng.random(len(time_s)) < wrong):
        depth = float(np.exp(rng.uniform(np.log(0.5), np.log(4.0))))
        found[k].append([*(rng.random(2) * size), depth, DISTANCE_RATIO * depth])
    first = np.concatenate([[0], np.cumsum([len(here) for here in found])])
    detections = np.reshape([row for here in found for row in here], (-1, 4))
    time_ns = np.round(time_s * 1e9).astype(np.int64)
    measured = [np.interp(time_s, log.time_s, angle) for angle in (log.roll_rad, log.pitch_rad)]
    nothing = np.zeros((len(time_s), 3))
    attitude = np.column_stack(measured)
    return ObserverLog(
        robot, AIDECK, time_ns, time_ns, detections, first, attitude, nothing, nothing[:, 0], {}, []
    )


def solve_without(pairs: dict[Names, Pair], _: dict[str, ObserverLog]) -> dict[Names, Estimate]:
    """Solve the pairs from ranges and odometry; return every ordered pair."""
    return _solve_both(pairs)


def solve_with(pairs: dict[Names, Pair], seen: dict[str, ObserverLog]) -> dict[Names, Estimate]:
    """Solve the pairs with detections; return every ordered pair."""
    found = {
        robot: detections_to_bearings(sight, 0, SAID_PX, ATTITUDE_STD_RAD)
        for robot, sight in seen.items()
    }
    looking = add_bearings(pairs, found)
    estimates = _solve_both(looking)
    again = resolve_conflicts(looking, estimates)
    return estimates | _solve_both(again) if again else estimates


def _solve_both(pairs: dict[Names, Pair]) -> dict[Names, Estimate]:
    """Return the estimates of pairs in both directions."""
    out: dict[Names, Estimate] = {}
    for (one, other), (here, there) in zip(
        pairs, estimate_pairs(list(pairs.values())), strict=True
    ):
        out |= {(one, other): here, (other, one): there}
    return out


WAYS: dict[str, Callable[[dict[Names, Pair], dict[str, ObserverLog]], dict[Names, Estimate]]] = {
    "without": solve_without,
    "with": solve_with,
}


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of a case and a method, for the peers of cf1; shares are over samples of all flights.

    Parameters
    ----------
    case, way
        Name of the case, and whether detections are used.
    rmse_m, worst_m
        Horizontal RMSE after 5 s: median and maximum over flights and peers.
    ellipse
        Share of samples inside the 95 % ellipse, after 5 s.
    kept, bad, worst_bad
        Share with status OK; share of these with an error over 0.3 m, and that share in the worst
        flight.
    cpu_s
        CPU seconds per flight.
    """

    case: str
    way: str
    rmse_m: float
    worst_m: float
    ellipse: float
    kept: float
    bad: float
    worst_bad: float
    cpu_s: float

    def __str__(self) -> str:
        return (
            f"{self.case:<24}{self.way:<10}{self.rmse_m:6.3f}{self.worst_m:7.2f}{self.ellipse:9.1%}"
            f"{self.kept:8.1%}{self.bad:8.2%}{self.worst_bad:8.1%}{self.cpu_s:7.2f}"
        )


def measure_case(name: str, noise: str, seeds: range) -> Iterator[Row]:
    """Simulate the flights of a case; yield a row for each method."""
    case = CASES[name]
    scenario = Scenario(case.robots, case.duration_s, case.trajectory)
    flights = [simulate(scenario, NOISE[noise], seed, FAULTS[case.fault].faults) for seed in seeds]
    pairs = [
        {both: build_pair(flight, *both) for both in combinations(flight.robots, 2)}
        for flight in flights
    ]
    seen = [simulate_detections(f, case.wrong, k) for f, k in zip(flights, seeds, strict=True)]
    for way, solve in WAYS.items():
        begun = time.process_time()
        found = [solve(*given) for given in zip(pairs, seen, strict=True)]
        spent_s = (time.process_time() - begun) / len(flights)
        flown = [list(_evaluate(*one)) for one in zip(flights, pairs, found, strict=True)]
        yield _row(name, way, flown, spent_s)


def _evaluate(
    flight: Flight, pairs: dict[Names, Pair], found: dict[Names, Estimate]
) -> Iterator[EvaluatedPositions]:
    """Compare the positions that the first robot estimates with the truth."""
    for (robot, peer), pair in pairs.items():
        if robot != "cf1":
            continue
        time_s = list_times(pair)
        xy, spread, status = found[robot, peer].interpolate_at(time_s)
        true_s = flight.clocks[robot].to_true_time(time_s)
        truth = flight.peer_in_horizontal(robot, peer, true_s)[:, :2]
        away = np.linalg.norm(truth, axis=1)
        yield EvaluatedPositions(time_s - time_s[0], xy - truth, spread, away, status == OK)


def _row(case: str, way: str, flown: list[list[EvaluatedPositions]], cpu_s: float) -> Row:
    """Build a row of the table from the positions of all flights."""
    every = [judged for here in flown for judged in here]
    late = [judged.time_s >= SETTLE_S for judged in every]
    rmse = [
        float(np.sqrt(np.mean(j.error_norm_m[at] ** 2))) for j, at in zip(every, late, strict=True)
    ]
    inside = [mahalanobis_squared(j)[at] <= CHI2_95_OF_2 for j, at in zip(every, late, strict=True)]
    bad = [
        np.concatenate([j.error_norm_m[j.kept] > MAX_GOOD_ERROR_M for j in here]) for here in flown
    ]
    total = np.concatenate(bad)
    return Row(
        case,
        way,
        float(np.median(rmse)),
        max(rmse),
        float(np.concatenate(inside).mean()),
        len(total) / sum(len(j.time_s) for j in every),
        _mean(total),
        max(_mean(here) for here in bad),
        cpu_s,
    )


def _mean(values: Array) -> float:
    """Return the mean, or 0 for no values."""
    return float(values.mean()) if len(values) else 0.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--noise", choices=[n for n in NOISE if n != "ideal"], default="calibrated")
    parser.add_argument("--only", choices=list(CASES), action="append", help="may be repeated")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.flights)
    print(f"{given.noise} noise, {given.flights} flights, seeds from {seeds[0]}; peers of cf1")
    print(
        f"{'case':<24}{'way':<10}{'RMSE':>6}{'worst':>7}{'ellipse':>9}{'kept':>8}{'bad':>8}"
        f"{'worst':>8}{'cpu-s':>7}"
    )
    rows = []
    for name in given.only or CASES:
        for row in measure_case(name, given.noise, seeds):
            rows.append(row)
            print(row, flush=True)
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
