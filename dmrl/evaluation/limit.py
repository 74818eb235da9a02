"""Limit of a simulated flight: the least error of a smoother that knows the simulator's noise.

The flight is simulated again from the provenance of the recording.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from dmrl.errors import SettingError
from dmrl.estimation.model.position_metrics import MAX_GOOD_ERROR_M
from dmrl.estimation.model.status import probability_beyond
from dmrl.flight import NOISE, Fault, Flight, Noise, Ranges, Scenario, simulate
from dmrl.flight.bound import compute_bound
from dmrl.geometry.frames import Array
from dmrl.labelling.flight_log import FlightLog, RobotPair, Times
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.recording import read_summary
from dmrl.samples.flight import START_NS
from dmrl.terminal.progress import say

BAD_SHARES = (0.01, 0.02)
"""Bad shares of kept positions at which the limit is given; the second is `dmrl label`'s."""
TOLERANCE_M = 1e-3
"""Largest difference of the true positions from those of the flight simulated again."""
TRUTH_STEP_S = 0.05
"""Time between recorded true positions, seconds."""
MIN_RECORDED = 0.1
"""Least share of a flight's true positions that a recording holds, so that it explains the work."""
MAX_WORK = 3e6
"""Largest fourth power of the robots times seconds: 1 GB for ten robots and five minutes."""

Bound = Callable[[RobotPair, Times], Array]
"""Least covariances (N, 2, 2) of a pair's positions at (N,) log times, square metres."""


def find_limit(held: FlightLog) -> Bound | None:
    """Find the limit of a recording; None if `dmrl fly` did not simulate it, or without noise.

    Parameters
    ----------
    held
        With the topics `flight_log.TRUTH_TOPICS`.
    """
    made = read_summary(held.path).provenance
    sources = [] if made is None else [made, *(s.provenance for _, s in made.iter_ancestors())]
    flown = [one.settings for one in sources if one is not None and one.stage == "fly"]
    paths = {pair: find_true_path(held, *pair) for pair in list_true_pairs(held.topics)}
    try:
        (settings,) = flown
        noise = NOISE[settings["noise"]]
        if settings.get("pilot"):
            return None  # what it flew by cannot be simulated again
        known = [field.name for field in fields(Scenario) if field.name in settings]
        # Without a pilot, none of the robots is flown by one.
        scenario = Scenario(**{name: settings[name] for name in known} | {"flown": 0})
        robots, duration_s = scenario.robots, scenario.duration_s
        true = robots * (robots - 1) * duration_s / TRUTH_STEP_S
        recorded = sum(len(time_ns) for time_ns, _ in paths.values())
        if noise == Noise() or recorded < MIN_RECORDED * true or robots**4 * duration_s > MAX_WORK:
            return None
        faults = [Fault(**fault) for fault in settings["faults"]]
        flight = simulate(scenario, noise, settings["seed"], faults)
    except (SettingError, KeyError, TypeError, ValueError):
        return None  # nothing that this version could fly
    if not all(_is_same_path(flight, pair, *path) for pair, path in paths.items()):
        say(f"{held.path}: this version of dmrl simulates the flight otherwise: no limit")
        return None
    recorded_ns = np.concatenate([time_ns for time_ns, _ in paths.values()])
    flight = replace(flight, ranges=_cut_ranges(flight, recorded_ns))
    bound = compute_bound(flight, noise, scenario.yaw_spread_rad)
    return lambda pair, time_ns: bound.interpolate_at(pair, _true_time_s(flight, pair[0], time_ns))


def _is_same_path(flight: Flight, pair: RobotPair, time_ns: Times, true_m: Array) -> bool:
    if not flight.robots.keys() >= {*pair}:
        return False
    again_m = flight.peer_in_horizontal(*pair, _true_time_s(flight, pair[0], time_ns))
    return np.allclose(true_m, again_m, rtol=0.0, atol=TOLERANCE_M)


def _cut_ranges(flight: Flight, recorded_ns: Times) -> dict[RobotPair, Ranges]:
    """Return the ranges while the recording lasts: of a trimmed flight others tell nothing."""
    first_ns, last_ns = int(recorded_ns.min()) - START_NS, int(recorded_ns.max()) - START_NS
    cut = {}
    for link, ranges in flight.ranges.items():
        inside = (ranges.time_s > first_ns * 1e-9) & (ranges.time_s < last_ns * 1e-9 + TRUTH_STEP_S)
        cut[link] = Ranges(ranges.time_s[inside], ranges.range_m[inside])
    return cut


def _true_time_s(flight: Flight, robot: str, time_ns: Times) -> Array:
    return flight.clocks[robot].to_true_time(np.asarray((time_ns - START_NS) * 1e-9, float))


def describe_limit(whole: Sequence[Array], settled: Sequence[Array]) -> dict[str, Any]:
    """Return the figures of the limit as JSON values.

    Parameters
    ----------
    whole, settled
        Covariances (N, 2, 2) of pairs, from the start, and after the settling time.
    """
    wrong = np.sort(probability_beyond(np.concatenate(whole), MAX_GOOD_ERROR_M))
    expected = np.cumsum(wrong) / np.arange(1, len(wrong) + 1)
    return {
        "rmse_m": _root_mean_variance(whole),
        "settled_rmse_m": _root_mean_variance(settled),
        "kept_share": {f"{share:g}": float((expected <= share).mean()) for share in BAD_SHARES},
    }


def _root_mean_variance(covariances: Sequence[Array]) -> float | None:
    variance = np.trace(np.concatenate(covariances), axis1=1, axis2=2)
    return float(np.sqrt(variance.mean())) if len(variance) else None
