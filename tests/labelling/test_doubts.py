from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.estimated import Estimate
from dmrl.estimation.problem import GLOBALS, Noise
from dmrl.labelling.report import doubts, refusal


def estimate(status: int = 0, **constants: float) -> Estimate:
    found = np.array([constants.get(name, 0.0) for name in GLOBALS])
    state, covariance = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)
    return Estimate(np.arange(2.0), state, covariance, np.full(2, status, np.int8), found, Noise())


def test_sensors_in_order_are_not_worth_a_line() -> None:
    assert doubts(("cf1", "cf2"), estimate(range_bias_m=0.1, own_velocity_scale=0.05)) == []


@pytest.mark.parametrize(
    ("constant", "value", "words"),
    [
        ("peer_gyro_bias_radps", 0.05, "cf2's yaw rate seems biased by 0.05 rad/s"),
        ("own_gyro_bias_radps", -0.05, "cf1's yaw rate seems biased by -0.05 rad/s"),
        ("own_velocity_scale", 0.2, "cf1's velocity seems 20% too large"),
        ("range_bias_m", 0.35, "ranges seem +0.35 m off"),
        ("peer_clock_s", 0.08, "cf2's log seems +0.08 s off"),
    ],
)
def test_a_sensor_that_is_off_is_named_with_what_to_do(
    constant: str, value: float, words: str
) -> None:
    (line,) = doubts(("cf1", "cf2"), estimate(**{constant: value}))
    assert words in line
    assert line.startswith("cf1-cf2: ")


def test_a_flight_of_which_nothing_is_kept_says_why_and_what_to_do() -> None:
    assert refusal(("cf1", "cf2"), estimate(status=0)) == []
    still = replace(estimate(status=2), refused="still")
    (line,) = refusal(("cf1", "cf2"), still)
    assert line.startswith("cf1 sees cf2: nothing is kept: cf1 hardly moves")
    (line,) = refusal(("cf1", "cf2"), estimate(status=1))
    assert "exact to 1.00 m" in line and "--gate-m" in line
