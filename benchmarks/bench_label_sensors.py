"""Measure what `dmrl calibrate --sensors` gains for robots with constant sensor errors.

Run as ``python benchmarks/bench_label_sensors.py FOLDER [--noise realistic] [--flights 6]
[--first-seed 9100]``. Two robots fly in view of each other. Their ranges are 0.35 m too long, the
yaw rate of cf2 is off by 0.05 rad/s, and the velocities of cf1 are 15 % too large. The constant
errors of the noise preset are added, drawn anew for every flight. `dmrl calibrate --sensors` learns
from flights of 100 s. `dmrl label` then processes other flights, short and long, without and with
the calibration.
"""

import argparse
from pathlib import Path

import numpy as np

from dmrl.flight import Fault
from dmrl.stages import calibrate, evaluate, fly, label
from dmrl.terminal.tables import print_table

OFF = (
    Fault("range_offset", "cf1", "cf2"),
    Fault("yaw_rate_bias", "cf2"),
    Fault("velocity_scale", "cf1"),
)
LENGTHS_S = 20.0, 30.0, 100.0
FIGURES = "rmse_m", "coverage_95", "kept", "precision"


def main() -> None:
    """Simulate, calibrate, label and evaluate; print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--noise", default="realistic")
    parser.add_argument("--flights", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=9100)
    given = parser.parse_args()
    given.folder.mkdir()
    seeds = iter(range(given.first_seed, given.first_seed + 100_000))

    def simulate_flights(length_s: float) -> list[Path]:
        settings = [
            fly.Settings(2, length_s, noise=given.noise, seed=next(seeds), faults=list(OFF))
            for _ in range(given.flights)
        ]
        paths = [given.folder / f"{length_s:g}-{one.seed}.mcap" for one in settings]
        for path, one in zip(paths, settings, strict=True):
            fly.run(path, one)
        return paths

    known = given.folder / "sensors.toml"
    calibrate.run(simulate_flights(100.0), known, calibrate.Settings(sensors=True))
    rows = []
    for length_s in LENGTHS_S:
        flights = simulate_flights(length_s)
        for name, sensors in (("without", None), ("with", known)):
            rows.append((f"{length_s:g}", name, *_evaluate(flights, name, sensors)))
    head = "RMSE, m", "in the 95 % ellipse", "kept", "bad of kept"
    print_table(f"{given.noise} noise", ("length, s", "sensors.toml", *head), rows)


def _evaluate(flights: list[Path], name: str, sensors: Path | None) -> tuple[float, ...]:
    """Label the flights; return median RMSE and shares in the ellipse, kept, and bad of kept."""
    found = []
    for flight in flights:
        out = flight.with_suffix(f".{name}.mcap")
        label.run(flight, out, label.Settings(sensors=sensors))
        judged = evaluate.run([out], None, evaluate.Settings(settle_s=0.0))
        assert isinstance(judged, dict)
        found.append([judged["overall"][figure] for figure in FIGURES])
    error_m, inside, kept, good = np.array(found, float).T
    bad = float(((1 - good) * kept)[kept > 0].sum() / kept.sum())
    return float(np.median(error_m)), float(inside.mean()), float(kept.mean()), bad


if __name__ == "__main__":
    main()
