from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.solver.estimate import PAIR_LAYOUT, Estimate
from dmrl.estimation.solver.layout import Subject, from_peer
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.labelling.pair_report import explain_refusal, explain_refusals, find_suspect_sensors


def estimate(status: int = 0, constants: dict[Subject, float] | None = None) -> Estimate:
    found = np.array([(constants or {}).get(s, 0.0) for s, _ in PAIR_LAYOUT.constants])
    state, covariance = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)
    return Estimate(
        np.arange(2.0), state, covariance, np.full(2, status, np.int8), found, NoiseModel()
    )


def test_sensors_in_order_are_not_worth_a_line() -> None:
    small: dict[Subject, float] = {("range_offset", (0, 1)): 0.1, ("velocity_scale", (0,)): 0.05}
    assert find_suspect_sensors(("cf1", "cf2"), estimate(constants=small)) == []


@pytest.mark.parametrize(
    ("constant", "value", "words"),
    [
        (("gyro_bias", (1,)), 0.05, "cf2's yaw rate seems biased by 0.05 rad/s"),
        (("gyro_bias", (0,)), -0.05, "cf1's yaw rate seems biased by -0.05 rad/s"),
        (("velocity_scale", (0,)), 0.2, "cf1's velocity seems 20% too large"),
        (("range_offset", (0, 1)), 0.35, "ranges seem +0.35 m off"),
        (("clock", (1,)), 0.08, "cf2's log seems +0.08 s off"),
    ],
)
def test_a_sensor_that_is_off_is_named_with_what_to_do(
    constant: Subject, value: float, words: str
) -> None:
    (line,) = find_suspect_sensors(("cf1", "cf2"), estimate(constants={constant: value}))
    assert line.startswith(words)


def test_a_flight_of_which_nothing_is_kept_says_why_and_what_to_do() -> None:
    assert explain_refusal(("cf1", "cf2"), estimate(status=0)) is None
    still = replace(estimate(status=2), rejection_reason="still")
    assert str(explain_refusal(("cf1", "cf2"), still)).startswith("cf1 hardly moves")
    why = str(explain_refusal(("cf1", "cf2"), estimate(status=1)))
    assert "exact to 1.00 m" in why and "--gate-m" in why


def test_what_is_off_is_the_reason_where_nothing_is_kept_and_a_line_of_its_own_elsewhere() -> None:
    lost = estimate(status=1, constants={("gyro_bias", (1,)): 0.05})
    there = replace(lost, constants=from_peer(PAIR_LAYOUT, lost.constants))
    here, back = explain_refusals([("cf1", "cf2")], {("cf1", "cf2"): lost, ("cf2", "cf1"): there})
    assert here.startswith("cf1 sees cf2: nothing is kept: cf2's yaw rate seems biased by 0.05")
    assert "exact to 1.00 m" in here
    assert back.startswith("cf2 sees cf1: nothing is kept: cf2's yaw rate seems biased by 0.05")

    kept = replace(there, status=np.zeros(2, np.int8))
    off, here = explain_refusals([("cf1", "cf2")], {("cf1", "cf2"): lost, ("cf2", "cf1"): kept})
    assert off.startswith("cf1-cf2: cf2's yaw rate seems biased by 0.05")
    assert here.startswith("cf1 sees cf2: nothing is kept: a position is exact to")

    assert explain_refusals([("cf1", "cf2")], {("cf1", "cf2"): estimate()}) == []
