"""Limit of a simulated flight: what a smoother that knows the simulator's noise could reach.

The flight is simulated again from the provenance of the recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from dmrl.errors import SettingError
from dmrl.estimation.model.position_metrics import MAX_GOOD_ERROR_M
from dmrl.estimation.model.status import probability_beyond
from dmrl.flight import NOISE, Fault, Flight, Noise, Ranges, Scenario, simulate
from dmrl.flight.bound import PositionBound, compute_bound, count_bound_bytes
from dmrl.geometry.frames import Array
from dmrl.labelling.flight_log import FlightLog, RobotPair, Times
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.recording import Provenance, read_summary
from dmrl.samples.flight import START_NS
from dmrl.terminal.progress import say

BAD_SHARES = (0.01, 0.02)
"""Bad shares of kept positions at which the limit is given; the second is `dmrl label`'s."""
TOLERANCE_M = 1e-3
"""Largest difference of the true positions from those of the flight simulated again."""
TRUTH_STEP_S = 0.05
"""Time between recorded true positions, seconds."""
MAX_BYTES = 1e9
"""Largest memory of a bound, bytes: ten robots for half an hour."""


class _Simulation(NamedTuple):
    """Arguments of `simulate`."""

    scenario: Scenario
    noise: Noise
    seed: int
    faults: tuple[Fault, ...]


@dataclass(frozen=True, slots=True)
class FlightLimit:
    """Bound of a flight, at log times of its observers."""

    flight: Flight
    bound: PositionBound

    def interpolate_at(self, pair: RobotPair, time_ns: Times) -> Array:
        """Return the bound's (N, 2, 2) covariances at (N,) log times, square metres."""
        return self.bound.interpolate_at(pair, _true_time_s(self.flight, pair[0], time_ns))


def find_limit(held: FlightLog) -> FlightLimit | None:
    """Find the limit of a recording; None if `dmrl fly` did not simulate it, or without noise.

    Parameters
    ----------
    held
        With the topics `flight_log.TRUTH_TOPICS`.
    """
    try:
        made = _find_simulation(read_summary(held.path).provenance)
        if made.noise == Noise() or not _is_affordable(held, made.scenario):
            return None
        flight = simulate(made.scenario, made.noise, made.seed, made.faults)
    except (SettingError, KeyError, TypeError, ValueError):
        return None  # nothing that this version could fly
    if not _is_same_motion(held, flight):
        say(f"{held.path}: this version of dmrl simulates the flight otherwise: no limit")
        return None
    flight = replace(flight, ranges=_select_recorded_ranges(held, flight))
    return FlightLimit(flight, compute_bound(flight, made.noise, made.scenario.yaw_spread_rad))


def _find_simulation(made: Provenance | None) -> _Simulation:
    """Return the one simulated flight that a recording comes from.

    Raises
    ------
    KeyError, TypeError, ValueError
        If there is none, or its settings are not complete.
    """
    sources = [] if made is None else [made, *(s.provenance for _, s in made.iter_ancestors())]
    (settings,) = (one.settings for one in sources if one is not None and one.stage == "fly")
    scenario = Scenario(*(settings[field.name] for field in fields(Scenario)))
    faults = tuple(Fault(**fault) for fault in settings["faults"])
    return _Simulation(scenario, NOISE[settings["noise"]], settings["seed"], faults)


def _is_affordable(held: FlightLog, scenario: Scenario) -> bool:
    """Return whether a recording explains the work: of what it claims to be, it holds a tenth."""
    robots, duration_s = scenario.robots, scenario.duration_s
    recorded = sum(len(find_true_path(held, *pair)[0]) for pair in list_true_pairs(held.topics))
    claimed = robots * (robots - 1) * duration_s / TRUTH_STEP_S
    return recorded > 0.1 * claimed and count_bound_bytes(robots, duration_s) < MAX_BYTES


def _is_same_motion(held: FlightLog, flight: Flight) -> bool:
    """Return whether the recorded true positions are those of the flight."""
    for pair in list_true_pairs(held.topics):
        if not flight.robots.keys() >= {*pair}:
            return False
        time_ns, true_m = find_true_path(held, *pair)
        again_m = flight.peer_in_horizontal(*pair, _true_time_s(flight, pair[0], time_ns))
        if not np.allclose(true_m, again_m, rtol=0.0, atol=TOLERANCE_M):
            return False
    return True


def _select_recorded_ranges(held: FlightLog, flight: Flight) -> dict[RobotPair, Ranges]:
    """Return the ranges while the recording lasts: of a trimmed flight others tell nothing."""
    paths = [find_true_path(held, *pair)[0] for pair in list_true_pairs(held.topics)]
    first_s, last_s = (
        (int(log_ns) - START_NS) * 1e-9
        for log_ns in (min(p[0] for p in paths), max(p[-1] for p in paths))
    )
    made = {}
    for link, (time_s, range_m) in ((k, (r.time_s, r.range_m)) for k, r in flight.ranges.items()):
        inside = (time_s >= first_s - TRUTH_STEP_S) & (time_s <= last_s + TRUTH_STEP_S)
        made[link] = Ranges(time_s[inside], range_m[inside])
    return made


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
