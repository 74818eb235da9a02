"""Compare one solve of all robots with pairwise solves: error, consistency, share kept and cost.

Run as ``python benchmarks/bench_swarm.py [--robots 3] [--noise realistic] [--only random]
[--flights 3]``. The flights last 100 s; both directions of every pair are evaluated. Errors and
the share inside the 95 % ellipse count after 20 s.
"""

import argparse
import time
from itertools import combinations

import numpy as np
from bench_label_faults import build_pair, evaluate, list_times

from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.flight.swarm import estimate_swarm
from dmrl.estimation.model.position_metrics import combine_figures, compute_figures
from dmrl.estimation.model.status import OK
from dmrl.flight import NOISE, TRAJECTORIES, Scenario, simulate

SETTLE_S = 20.0


def main() -> None:
    """Print a row per flight and method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--noise", choices=list(NOISE), default="realistic")
    parser.add_argument("--only", choices=list(TRAJECTORIES), default="random")
    parser.add_argument("--flights", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    given = parser.parse_args()
    print(f"{given.robots} robots, {given.noise}, {given.only}; RMSE: median and maximum of pairs")
    print("  seed method   RMSE    max  ellipse    min   kept     bad   worst   cpu-s")
    for seed in range(given.first_seed, given.first_seed + given.flights):
        flight = simulate(Scenario(given.robots, 100.0, given.only), NOISE[given.noise], seed)
        pairs = {names: build_pair(flight, *names) for names in combinations(flight.robots, 2)}
        begun = time.process_time()
        both = estimate_pairs(list(pairs.values()))
        found = {n: e[0] for n, e in zip(pairs, both, strict=True)}
        found |= {n[::-1]: e[1] for n, e in zip(pairs, both, strict=True)}
        pairwise_s = time.process_time() - begun
        swarm = estimate_swarm(pairs, found)
        swarm_s = time.process_time() - begun
        for method, estimates, spent_s in (
            ("pairs", found, pairwise_s),
            ("swarm", swarm, swarm_s),
        ):
            rows = []
            for names, estimate in estimates.items():
                time_s = list_times(pairs[names] if names in pairs else pairs[names[::-1]])
                xy, spread, status = estimate.interpolate_at(time_s)
                seen = evaluate(flight, *names, time_s, (xy, spread, status == OK))
                rows.append(compute_figures(seen, SETTLE_S))
            every = combine_figures(rows)
            worst = np.nanmax([1 - row.precision for row in rows] or [np.nan])
            print(
                f"{seed:6d} {method:<7}{every.rmse_m:6.3f}{max(r.rmse_m for r in rows):7.3f}"
                f"{every.coverage_95:9.1%}{min(r.coverage_95 for r in rows):7.1%}"
                f"{every.kept:7.1%}{1 - every.precision:8.2%}{worst:8.2%}{spent_s:8.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
