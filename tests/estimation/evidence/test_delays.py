"""Delayed signals are found, moved back and named."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.evidence.delays import SIGNALS, Delay, join_delays, move_signal
from dmrl.estimation.evidence.error_models import Candidate, list_candidates
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import Pair

from ..flights import build_pair, build_two_way_pair, compute_truth, simulate_flight

MODELS = {
    row.name: one
    for one in list_candidates()
    if one.robot in (1, None)
    for row in one.model.rows
    if row.name in SIGNALS
}
"""Error models of a delay of the second robot or of the pair, by name of their unknown."""


def delay_flow(pair: Pair, delay_s: float) -> Pair:
    """Return a pair whose second robot logs its velocities late."""
    return move_signal(pair, Delay("flow_delay", MODELS["flow_delay"], -delay_s))


def test_every_signal_has_its_error_model() -> None:
    assert MODELS.keys() == SIGNALS.keys()


def test_gaps_of_a_late_yaw_rate_move_with_it() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    gap = np.arange(len(pair.time_s)) // 100 == 5
    peer = replace(pair.peer, dropout=gap, turn_dropout=gap)
    delay = Delay("yaw_rate_delay", MODELS["yaw_rate_delay"], 0.3)
    moved = move_signal(replace(pair, peer=peer), delay).peer
    assert moved.turn_dropout is not None
    assert moved.turn_dropout[470:600].all() and not moved.turn_dropout[:470].any()


@pytest.mark.parametrize("unknown", list(SIGNALS))
def test_a_delay_moves_one_signal_only(unknown: str) -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    moved = move_signal(pair, Delay(unknown, MODELS[unknown], 0.3))
    assert moved.own is pair.own
    for name in ("vx_mps", "vy_mps", "yaw_rate_radps", "height_m"):
        before, after = getattr(pair.peer, name), getattr(moved.peer, name)
        if name in SIGNALS[unknown]:
            np.testing.assert_array_equal(after[:-30], before[30:])
            assert moved.peer.dropout[-30:].all() and not moved.peer.dropout[:-30].any()
        else:
            np.testing.assert_array_equal(after, before)
    if unknown == "range_delay":
        kept = pair.range_time_s >= pair.time_s[0] + 0.3
        np.testing.assert_allclose(moved.range_time_s, pair.range_time_s[kept] - 0.3)
        np.testing.assert_array_equal(moved.range_m, pair.range_m[kept])
    else:
        assert moved.range_m is pair.range_m


def test_most_windows_must_show_a_delay() -> None:
    model: Candidate = MODELS["flow_delay"]
    some = [Delay("flow_delay", model, delay_s) for delay_s in (0.2, 0.3, 0.4)]
    assert join_delays([*some, None]) == some[1]
    assert join_delays([some[0], None]) is None
    assert join_delays([]) is None


@pytest.mark.heavy
def test_long_delays_are_moved_and_named_once() -> None:
    flight = simulate_flight("in_view", "calibrated", 1003, 60.0)
    late = delay_flow(build_pair(flight), 0.3)
    ((plain, _),) = estimate_pairs([late], plain=True)
    ((found, other),) = estimate_pairs([late])
    rmse_m = [
        np.sqrt(np.square(one.state[:, :2] - compute_truth(flight, one.time_s)).sum(axis=1).mean())
        for one in (plain, found)
    ]
    assert rmse_m[1] < 0.6 * rmse_m[0]
    assert [cause.name for cause in found.causes if cause.robot == 1] == ["flow late"]
    assert [cause.name for cause in other.causes if cause.robot == 0] == ["flow late"]


@pytest.mark.heavy
def test_late_ranges_of_both_robots_are_no_offset_of_a_clock() -> None:
    flight = simulate_flight("in_view", "calibrated", 1003, 60.0)
    sound = build_two_way_pair(flight)
    late = move_signal(sound, Delay("range_delay", MODELS["range_delay"], -0.3))
    ((plain, _),), ((found, _),) = estimate_pairs([sound]), estimate_pairs([late])
    rmse_m = [
        np.sqrt(np.square(one.state[:, :2] - compute_truth(flight, one.time_s)).sum(axis=1).mean())
        for one in (plain, found)
    ]
    assert rmse_m[1] < 1.2 * rmse_m[0]
    assert [cause.name for cause in found.causes] == ["range late"]


@pytest.mark.heavy
def test_a_sound_flight_shows_no_delay() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1003, 20.0))
    ((found, _),) = estimate_pairs([replace(pair)])
    assert not [cause for cause in found.causes if "late" in cause.name]
