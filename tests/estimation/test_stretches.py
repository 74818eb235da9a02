from dataclasses import replace

import numpy as np

from dmrl.estimation.estimate import Estimate
from dmrl.estimation.gate import OK, UNCONVERGED
from dmrl.estimation.pair import Pair
from dmrl.estimation.problem import GLOBALS, Noise
from dmrl.estimation.stretches import contradicts, mended, stretches

from .flights import flown, pair_of


def silent(pair: Pair, start_s: float, end_s: float) -> Pair:
    """The pair without ranges for a while."""
    heard = (pair.range_time_s < start_s) | (pair.range_time_s > end_s)
    return replace(pair, range_time_s=pair.range_time_s[heard], range_m=pair.range_m[heard])


def standing(time_s: np.ndarray, x_m: float, status: int = OK) -> Estimate:
    """A peer that is x_m ahead, known to 0.1 m."""
    state = np.tile([x_m, 0.0, 0.0], (len(time_s), 1))
    spread = np.tile(0.01 * np.eye(3), (len(time_s), 1, 1))
    constants = np.zeros(len(GLOBALS))
    statuses = np.full(len(time_s), status, np.int8)
    return Estimate(time_s, state, spread, statuses, constants, Noise())


def test_long_silences_of_the_ranges_part_a_flight() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 60.0))
    assert stretches(pair) == []
    early, late = stretches(silent(pair, 20.0, 40.0))
    assert early.time_s[-1] <= 20.1 and late.time_s[0] >= 39.9
    lost = len(silent(pair, 20.0, 40.0).range_m) - len(early.range_m) - len(late.range_m)
    assert 0 <= lost <= 2  # between two samples of the grid
    assert len(stretches(silent(pair, 5.0, 20.0))) == 1  # five seconds tell nothing


def test_a_stretch_that_is_sure_counts_against_the_whole_flight() -> None:
    pair = silent(pair_of(flown("in_view", "calibrated", 1000, 60.0)), 20.0, 40.0)
    key_s = np.arange(0.0, 60.0, 0.1) + pair.time_s[0]
    whole = standing(key_s, 1.0)

    def solve(parts: list[Pair]) -> list[tuple[Estimate, Estimate]]:
        late = standing(parts[1].time_s, -1.0)
        return [(standing(parts[0].time_s, 1.0),) * 2, (late, late)]

    here, there = mended(pair, (whole, whole), solve)
    after = key_s > 40.5
    assert (here.state[after, 0] == -1.0).all() and (here.state[key_s < 39.0, 0] == 1.0).all()
    assert (there.state[after, 0] == -1.0).all()


def test_who_is_not_sure_contradicts_nobody() -> None:
    time_s = np.arange(0.0, 20.0, 0.1)
    whole = standing(time_s, 1.0)
    assert contradicts(whole, standing(time_s, 2.0))
    assert not contradicts(whole, standing(time_s, 1.1))
    assert not contradicts(whole, standing(time_s, 2.0, UNCONVERGED))
