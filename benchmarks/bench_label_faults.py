"""Compare labelling methods on flights with faults: which stay accurate, and which report errors.

Run as ``python benchmarks/bench_label_faults.py [--flights 10] [--noise calibrated] [--json FILE]
[--plot STEM]``. Each flight lasts 100 s with the peer in view, and has one fault and ranges in both
directions. Both robots are observers. The methods are the batch solve of `dmrl label`, the
published filter, and a plain factor graph if gtsam is installed (``pip install gtsam``, or the
dependency group ``bench``). All three use the same gate. The batch solve has limits; if it exceeds
one, the exit status is 1.
"""

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from fault_cases import BAD, CASES
from matplotlib.figure import Figure

from dmrl.estimation.flight.pairs import estimate_ekf, estimate_pairs
from dmrl.estimation.model.pair import GRID_RATE_HZ, Mask, Pair, usable_ranges
from dmrl.estimation.model.position_metrics import (
    CHI2_95_OF_2,
    MAX_GOOD_ERROR_M,
    EvaluatedPositions,
    mahalanobis_squared,
)
from dmrl.estimation.model.status import OK, classify_positions
from dmrl.estimation.solver.estimate import Estimate
from dmrl.flight import NOISE, Flight, Scenario, simulate
from dmrl.geometry.frames import Array
from dmrl.labelling.sensor_logs import RobotLog

SETTLE_S = 20.0
MARGIN_S = 1.0
"""Margin around the window of a fault that counts as part of it, seconds."""
HEAD = (
    f"{'fault':<24}{'method':<11}{'RMSE':>6}{'outside':>9}{'ellipse':>9}{'kept':>7}{'bad':>8}"
    f"{'worst':>8}{'cpu-s':>8}"
)
Found = tuple[Array, Array, Mask]
"""Positions (N, 2) of the peer, metres, covariances (N, 2, 2), and which are kept (N,)."""


def build_pair(flight: Flight, one: str, other: str) -> Pair:
    """Return a pair as `dmrl label` would read it from a recording of the flight."""
    logs = [_signals(flight, robot) for robot in (one, other)]
    start_s, end_s = max(log.start_s for log in logs), min(log.end_s for log in logs)
    grid_s = start_s + np.arange(int((end_s - start_s) * GRID_RATE_HZ) + 1) / GRID_RATE_HZ
    ranges = [flight.ranges[link] for link in ((one, other), (other, one))]
    time_s, range_m = (
        np.concatenate([getattr(r, name) for r in ranges]) for name in ("time_s", "range_m")
    )
    order = np.argsort(time_s, kind="stable")
    time_s, range_m = time_s[order], range_m[order]
    good = usable_ranges(time_s, range_m) & (time_s >= grid_s[0]) & (time_s <= grid_s[-1])
    own, peer = (log.to_track(grid_s) for log in logs)
    return Pair(grid_s, own, peer, time_s[good], range_m[good])


def _signals(flight: Flight, robot: str) -> RobotLog:
    """Return the log of a robot without samples in which a sensor gave no value."""
    log = flight.robots[robot]
    columns = (
        np.stack([log.roll_rad, log.pitch_rad, log.yaw_rate_radps], axis=1),
        np.stack([log.vx_mps, log.vy_mps], axis=1),
        log.height_m[:, None],
    )
    sensed = [np.isfinite(values).all(axis=1) for values in columns]
    return RobotLog(*((log.time_s[at], v[at]) for at, v in zip(sensed, columns, strict=True)))


def solve_batch(pairs: list[Pair]) -> list[tuple[Found, Found]]:
    """Solve the pairs like `dmrl label`; return both directions of each."""
    both = zip(pairs, estimate_pairs(pairs), strict=True)
    return [(_at(here, pair), _at(there, pair)) for pair, (here, there) in both]


def run_published_filter(pairs: list[Pair]) -> list[tuple[Found, Found]]:
    """Run the filter of Li et al. 2020, like ``dmrl label --method ekf``."""
    both = [*pairs, *(pair.swap_robots() for pair in pairs)]
    found = [_at(e, p) for e, p in zip(estimate_ekf(both, "published-sim"), both, strict=True)]
    return list(zip(found[: len(pairs)], found[len(pairs) :], strict=True))


def _at(estimate: Estimate, pair: Pair) -> Found:
    """Interpolate an estimate to the times of a pair's log."""
    xy, spread, status = estimate.interpolate_at(list_times(pair))
    return xy, spread, status == OK


def solve_graph(pairs: list[Pair]) -> list[tuple[Found, Found]]:
    """Solve the plain factor graph, which has no error models."""
    import graph_peer  # noqa: PLC0415  # gtsam is optional

    out = []
    for pair in pairs:
        here, there = graph_peer.solve(pair)
        out.append((_interpolate_graph(pair, *here), _interpolate_graph(pair, *there)))
    return out


def _interpolate_graph(pair: Pair, key_s: Array, state: Array, covariance: Array) -> Found:
    """Interpolate a state of a factor graph to the times of a pair's log."""
    status, time_s = classify_positions(state, covariance), list_times(pair)
    at = np.clip(np.searchsorted(key_s, time_s), 0, len(key_s) - 1)
    xy = np.stack([np.interp(time_s, key_s, axis) for axis in state[:, :2].T], axis=1)
    return xy, covariance[at, :2, :2], status[at] == OK


def list_times(pair: Pair) -> Array:
    """Return the (N,) times at which a pair is evaluated, 20 per second."""
    return np.arange(pair.time_s[0], pair.time_s[-1], 0.05)


METHODS: dict[str, Callable[[list[Pair]], list[tuple[Found, Found]]]] = {
    "batch": solve_batch,
    "published": run_published_filter,
    "graph": solve_graph,
}


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of a fault and a method: medians over flights and directions, shares of samples.

    Parameters
    ----------
    noise, fault, method
        Noise preset, name of the case, and method.
    rmse_m, outside_m
        Horizontal RMSE after 20 s: of all samples, and of those outside the windows of the faults.
    ellipse
        Share of samples inside the 95 % ellipse, after 20 s.
    kept, bad, worst
        Share with status OK; share of these with an error over 0.3 m, and that share in the worst
        flight.
    cpu_s
        CPU seconds per flight, both directions.
    over
        Limits that it exceeds.
    """

    noise: str
    fault: str
    method: str
    rmse_m: float
    outside_m: float
    ellipse: float
    kept: float
    bad: float
    worst: float
    cpu_s: float
    over: tuple[str, ...] = ()

    def __str__(self) -> str:
        return (
            f"{self.fault:<24}{self.method:<11}{self.rmse_m:6.2f}{self.outside_m:9.2f}"
            f"{self.ellipse:9.1%}{self.kept:7.1%}{self.bad:8.2%}{self.worst:8.1%}"
            f"{self.cpu_s:8.2f}  {', '.join(self.over)}"
        ).rstrip()


def evaluate(
    flight: Flight, robot: str, peer: str, time_s: Array, found: Found
) -> EvaluatedPositions:
    """Compare the estimates with the truth."""
    xy, covariance, kept = found
    truth = flight.peer_in_horizontal(robot, peer, flight.clocks[robot].to_true_time(time_s))[:, :2]
    distance = np.linalg.norm(truth, axis=1)
    return EvaluatedPositions(time_s - time_s[0], xy - truth, covariance, distance, kept)


def find_calm(flight: Flight, true_s: Array) -> Mask:
    """Return (N,) whether a time is at least a second away from every fault.

    Faults that last for the whole flight do not count.
    """
    calm = np.ones(len(true_s), bool)
    for start, end in (w for event in flight.faults for w in event.windows_s.tolist()):
        whole = start <= 0 and not np.isfinite(end)
        calm &= (true_s < start - MARGIN_S) | (true_s > end + MARGIN_S) | whole
    return calm


def measure_case(name: str, noise: str, seeds: range, methods: list[str]) -> list[Row]:
    """Simulate the flights of a case; return the figures of every method."""
    flights = [simulate(Scenario(), NOISE[noise], seed, CASES[name].faults) for seed in seeds]
    pairs = [build_pair(flight, "cf1", "cf2") for flight in flights]
    rows = []
    for method in methods:
        begun = time.process_time()
        found = METHODS[method](pairs)
        spent_s = (time.process_time() - begun) / len(seeds)
        seen = [_evaluate_both(*one) for one in zip(flights, pairs, found, strict=True)]
        rows.append(_row(name, noise, method, seen, spent_s))
    return rows


def _evaluate_both(
    flight: Flight, pair: Pair, found: tuple[Found, Found]
) -> list[tuple[EvaluatedPositions, Mask]]:
    """Compare both directions of a flight with the truth; also return which samples are calm."""
    time_s = list_times(pair)
    calm = find_calm(flight, flight.clocks["cf1"].to_true_time(time_s))
    both = zip((("cf1", "cf2"), ("cf2", "cf1")), found, strict=True)
    return [(evaluate(flight, *names, time_s, what), calm) for names, what in both]


def _row(
    name: str,
    noise: str,
    method: str,
    flown: list[list[tuple[EvaluatedPositions, Mask]]],
    cpu_s: float,
) -> Row:
    """Build a row of the table from the positions of all flights."""
    ways = [way for both in flown for way in both]
    late = [j.time_s >= SETTLE_S for j, _ in ways]
    rmse = [_rms(j.error_norm_m[at]) for (j, _), at in zip(ways, late, strict=True)]
    calm = [_rms(j.error_norm_m[at & quiet]) for (j, quiet), at in zip(ways, late, strict=True)]
    inside = np.concatenate([mahalanobis_squared(j) <= CHI2_95_OF_2 for j, _ in ways])
    bad = [
        np.concatenate([j.error_norm_m[j.kept] > MAX_GOOD_ERROR_M for j, _ in both])
        for both in flown
    ]
    every = np.concatenate(bad)
    return _check_limits(
        Row(
            noise=noise,
            fault=name,
            method=method,
            rmse_m=float(np.median(rmse)),
            outside_m=float(np.median(calm)),
            ellipse=float(inside[np.concatenate(late)].mean()),
            kept=len(every) / len(inside),
            bad=float(every.mean()) if len(every) else 0.0,
            worst=max((float(b.mean()) for b in bad if len(b)), default=0.0),
            cpu_s=cpu_s,
        )
    )


def _rms(size_m: Array) -> float:
    """Return the root mean square, or NaN for no values."""
    return float(np.sqrt(np.mean(size_m**2))) if len(size_m) else np.nan


def _check_limits(row: Row) -> Row:
    """Return the row with the limits that it exceeds; only the batch solve has limits."""
    if row.method != "batch":
        return row
    case, (bad, worst) = CASES[row.fault], BAD[row.noise]
    limits = [
        (row.bad > bad, f"bad over {bad:.0%}"),
        (row.worst > worst, f"worst over {worst:.0%}"),
    ]
    if row.noise == "calibrated":
        limits += [
            (row.outside_m > case.outside_m, f"outside over {case.outside_m:g} m"),
            (row.kept < case.kept, f"kept under {case.kept:.0%}"),
        ]
    over = tuple(said for broken, said in limits if broken)
    return Row(**{**asdict(row), "over": over})


def draw(rows: list[Row], stem: Path) -> None:
    """Draw RMSE, share in the ellipse, share kept and share bad of every fault, by method."""
    faults = list(dict.fromkeys(row.fault for row in rows))
    figure = Figure((10.0, 0.6 + 0.27 * len(faults)), layout="constrained")
    panels = figure.subplots(1, 4, sharey=True)
    titles = "RMSE, m", "in the 95 % ellipse", "kept", "bad of kept, worst flight"
    for axes, key, title in zip(
        panels, ("rmse_m", "ellipse", "kept", "worst"), titles, strict=True
    ):
        for method, mark in zip(METHODS, "osx", strict=True):
            if not (mine := [row for row in rows if row.method == method]):
                continue  # methods that were not run do not appear in the legend
            places = [faults.index(row.fault) for row in mine]
            axes.plot([getattr(row, key) for row in mine], places, mark, label=method, alpha=0.8)
        axes.set_title(title, fontsize=9)
        axes.grid(alpha=0.3)
        if key != "rmse_m":
            axes.set_xlim(-0.04, 1.04)
    panels[0].set(xscale="log", yticks=range(len(faults)), yticklabels=faults, xlim=(0.05, 5.0))
    panels[0].set_xticks([0.1, 1.0], ["0.1", "1"])
    panels[0].invert_yaxis()
    # The legend lies below the panels, since inside one it would cover points.
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(stem.with_suffix(".png"), dpi=130)


def main() -> int:
    """Print the table; return 1 if the batch solve exceeds a limit, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--noise", choices=list(BAD), default="calibrated")
    parser.add_argument("--only", choices=list(CASES), action="append", help="may be repeated")
    parser.add_argument("--method", choices=list(METHODS), action="append", help="may be repeated")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--plot", type=Path, help="draw STEM.png")
    parser.add_argument(
        "--beside", type=Path, action="append", default=[], help="JSON of other runs to draw, too"
    )
    given = parser.parse_args()
    methods = given.method or list(METHODS)
    if "graph" in methods and importlib.util.find_spec("gtsam") is None:
        methods.remove("graph")
        print("skipped graph: it needs gtsam. pip install gtsam", file=sys.stderr)
    seeds = range(given.first_seed, given.first_seed + given.flights)
    print(f"{given.noise} noise, {given.flights} flights of 100 s in view, seeds from {seeds[0]}")
    print("RMSE and ellipse: after 20 s; outside: RMSE outside the windows of the fault")
    print("bad: share of kept positions with an error over 0.3 m; worst: that of the worst flight")
    print(HEAD)
    rows = []
    for name in given.only or CASES:
        rows += measure_case(name, given.noise, seeds, methods)
        print(*rows[-len(methods) :], sep="\n", flush=True)
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    if given.plot:
        others = [Row(**row) for path in given.beside for row in json.loads(path.read_text())]
        draw([*rows, *others], given.plot)
    return int(any(row.over for row in rows))


if __name__ == "__main__":
    sys.exit(main())
