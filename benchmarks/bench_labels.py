"""Evaluate relative positions from simulated UWB and flow: error, consistency, gate and cost.

Run as ``python benchmarks/bench_labels.py [--flights 50] [--only in_view]``. Simulates flights of
100 s for each noise preset and trajectory. The position of cf2 relative to cf1 is estimated by the
batch solve and by the published filter, and compared with what an ideal gate would keep. Then
prints the CPU seconds by length of the flight and by number of robots; ``--plot STEM`` draws them.
"""

import argparse
import time
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dmrl.estimation.flight.pairs import estimate_ekf, estimate_pairs
from dmrl.estimation.model.pair import Mask, Pair, SensorTrack, usable_ranges
from dmrl.estimation.model.position_metrics import (
    MAX_GOOD_ERROR_M,
    EvaluatedPositions,
    PairFigures,
    combine_figures,
    compute_figures,
)
from dmrl.estimation.model.status import AMBIGUOUS, OK, probability_beyond
from dmrl.estimation.signals.sensor_tracks import build_track
from dmrl.estimation.solver.estimate import Estimate
from dmrl.flight import NOISE, TRAJECTORIES, Flight, RobotLog, Scenario, simulate
from dmrl.geometry.frames import Array

SETTLE_S = 20.0
EKF = "published-sim"
BAD_SHARE = 0.01
"""Share of bad samples that a gate may let through."""
PRESETS = ("calibrated", "realistic", "harsh")
HEAD = (
    f"{'noise':<11}{'trajectory':<16}{'method':<10}{'RMSE':>7}{'95 %':>7}{'worst':>7}{'wrong':>7}"
    f"{'NEES':>7}{'cover':>7}{'kept':>7}{'good':>8}{'cover':>7}{'cpu-s':>7}"
)


@dataclass(frozen=True, slots=True)
class Flown:
    """Figures of one flight, and the data to find the best gate.

    Parameters
    ----------
    figures
        Figures as printed by `dmrl evaluate`.
    probability
        (N,) probability that a sample is bad, from its covariance; infinite where AMBIGUOUS.
    bad
        (N,) whether the error is larger than 0.3 m.
    """

    figures: PairFigures
    probability: Array
    bad: Mask


def build_pair(flight: Flight, robot: str, peer: str) -> Pair:
    """Return both logs with their time stamps, and only the ranges that the robot measured."""
    logs = flight.robots[robot], flight.robots[peer]
    start, end = max(log.time_s[0] for log in logs), min(log.time_s[-1] for log in logs)
    grid_s = start + np.arange(int((end - start) * 100)) / 100
    ranges = flight.ranges[robot, peer]
    inside = (ranges.time_s >= grid_s[0]) & (ranges.time_s <= grid_s[-1])
    inside &= usable_ranges(ranges.time_s, ranges.range_m)
    own, other = (resample(log, grid_s) for log in logs)
    return Pair(grid_s, own, other, ranges.time_s[inside], ranges.range_m[inside])


def resample(log: RobotLog, grid_s: Array) -> SensorTrack:
    """Resample the log of a robot on a common time grid."""
    velocity = np.stack([log.vx_mps, log.vy_mps], axis=1)
    yaw_rate, height = log.yaw_rate_radps[:, None], log.height_m[:, None]
    return build_track(*((log.time_s, values) for values in (yaw_rate, velocity, height)), grid_s)


def evaluate(flight: Flight, robot: str, peer: str, estimate: Estimate) -> Flown:
    """Compare an estimate with the truth, 20 times per second."""
    time_s = np.arange(estimate.time_s[0], estimate.time_s[-1], 0.05)
    position, covariance, status = estimate.interpolate_at(time_s)
    truth = flight.peer_in_horizontal(robot, peer, flight.clocks[robot].to_true_time(time_s))[:, :2]
    distance = np.linalg.norm(truth, axis=1)
    both = EvaluatedPositions(
        time_s - time_s[0], position - truth, covariance, distance, status == OK
    )
    probability = np.where(
        status == AMBIGUOUS, np.inf, probability_beyond(covariance, MAX_GOOD_ERROR_M)
    )
    return Flown(compute_figures(both, SETTLE_S), probability, both.error_norm_m > MAX_GOOD_ERROR_M)


def compute_best_gate(flown: list[Flown]) -> float:
    """Return the share of samples kept by the best limit on the probability.

    The limit is chosen with the truth known, such that at most `BAD_SHARE` of the samples are bad.
    """
    probability = np.concatenate([f.probability for f in flown])
    order = np.argsort(probability, kind="stable")
    count = np.arange(1, np.isfinite(probability).sum() + 1)
    bad = np.cumsum(np.concatenate([f.bad for f in flown])[order][: len(count)])
    return float(count[bad <= BAD_SHARE * count].max(initial=0) / len(probability))


def run_monte_carlo(
    noise: str, trajectory: str, seeds: range, methods: tuple[str, ...]
) -> dict[str, tuple[list[Flown], float]]:
    """Return the evaluated flights and the CPU seconds per flight, by method."""
    flown = [
        simulate(Scenario(trajectory=trajectory), NOISE[noise], seed)  # type: ignore[arg-type]
        for seed in seeds
    ]
    pairs = [build_pair(flight, "cf1", "cf2") for flight in flown]
    solve = {
        "batch": lambda: [here for here, _ in estimate_pairs(pairs)],
        "published": lambda: estimate_ekf(pairs, EKF),
    }
    out = {}
    for name in methods:
        begun = time.process_time()
        estimates = solve[name]()
        cost_s = (time.process_time() - begun) / len(seeds)
        both = zip(flown, estimates, strict=True)
        out[name] = [evaluate(f, "cf1", "cf2", e) for f, e in both], cost_s
    return out


def format_row(noise: str, trajectory: str, method: str, flown: list[Flown], cost_s: float) -> str:
    """Return a row of the table: medians over flights, and shares of flights or of samples."""
    found = [f.figures for f in flown]
    every, worst = combine_figures(found), max(f.rmse_m for f in found)
    return (
        f"{noise:<11}{trajectory:<16}{method:<10}{every.rmse_m:7.3f}{every.p95_m:7.3f}"
        f"{worst:7.2f}{every.wrong_basin:7.0%}{every.nees:7.1f}{every.coverage_95:7.1%}"
        f"{every.kept:7.1%}{every.precision:8.2%}{every.kept_coverage_95:7.1%}{cost_s:7.2f}"
    )


def measure_cost(robots: int, duration_s: float, flights: int) -> float:
    """Return the CPU seconds to solve all ordered pairs of a flight."""
    spent_s = 0.0
    for seed in range(flights):
        flight = simulate(Scenario(robots, duration_s, "random"), NOISE["realistic"], seed)
        pairs = [build_pair(flight, *both) for both in combinations(flight.robots, 2)]
        begun = time.process_time()
        estimate_pairs(pairs)
        spent_s += time.process_time() - begun
    return spent_s / flights


def print_costs(stem: Path | None) -> None:
    """Print the cost by length of the flight and by number of pairs; draw it if a path is given."""
    lengths = [(s, measure_cost(2, s, 3)) for s in (25.0, 50.0, 100.0, 200.0, 400.0)]
    swarms = [(n * (n - 1), measure_cost(n, 100.0, 1)) for n in (2, 3, 5, 7, 10)]
    for what, rows in (("seconds of flight, 2 pairs", lengths), ("pairs, 100 s", swarms)):
        print(f"\n{what:>28}   cpu-s")
        for size, seconds in rows:
            print(f"{size:28.0f}{seconds:8.2f}")
    if stem is not None:
        figure = Figure((7.0, 3.0), layout="constrained")
        for axes, what, rows in zip(
            figure.subplots(1, 2),
            ("length of the flight, s", "ordered pairs, 100 s each"),
            (lengths, swarms),
            strict=True,
        ):
            axes.plot(*zip(*rows, strict=True), "o-")
            axes.set(xlabel=what, ylabel="CPU seconds", xlim=(0, None), ylim=(0, None))
            axes.grid(alpha=0.3)
        figure.savefig(stem.with_suffix(".png"), dpi=150)


def print_figures(given: argparse.Namespace) -> None:
    """Print the figures of each noise preset by trajectory, and over all trajectories."""
    print(f"{given.flights} flights of 100 s each; RMSE, 95 % and coverage after {SETTLE_S:g} s")
    print("kept: status OK; good: kept samples within 0.3 m; second coverage: of kept samples")
    print(f"best gate: limit on the probability that keeps most samples with {BAD_SHARE:.0%} bad")
    print(HEAD)
    seeds = range(given.first_seed, given.first_seed + given.flights)
    methods = ("batch",) if given.no_published else ("batch", "published")
    for noise in [given.noise] if given.noise else PRESETS:
        every: dict[str, list[Flown]] = {}
        for trajectory in [given.only] if given.only else TRAJECTORIES:
            found = run_monte_carlo(noise, trajectory, seeds, methods)
            for method, (flown, cost_s) in found.items():
                print(format_row(noise, trajectory, method, flown, cost_s), flush=True)
                every.setdefault(method, []).extend(flown)
        for method, flown in every.items():
            print(format_row(noise, "all of these", method, flown, float("nan")))
        share = compute_best_gate(every["batch"])
        print(f"{noise}: the best gate keeps {share:.1%} of the samples of the batch solve\n")


def main() -> None:
    """Print every table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", choices=list(TRAJECTORIES))
    parser.add_argument("--noise", choices=[n for n in NOISE if n != "ideal"])
    parser.add_argument("--no-published", action="store_true", help="run the batch solve only")
    parser.add_argument("--no-costs", action="store_true")
    parser.add_argument("--costs-only", action="store_true")
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    if not given.costs_only:
        print_figures(given)
    if not given.no_costs:
        print_costs(given.plot)


if __name__ == "__main__":
    main()
