"""Interpolation of estimates between keyframes, and their transform to the other robot."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.estimation.model.status import AMBIGUOUS, OK, UNCONVERGED
from dmrl.estimation.solver.estimate import (
    PAIR_LAYOUT,
    Estimate,
    seen_from_peer,
    transform_to_peer,
)
from dmrl.estimation.solver.problem import NoiseModel

COUNT = 4


def draw_estimate(seed: int = 0) -> Estimate:
    """Draw a random estimate at 3, 3.5, 4 and 4.5 s."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(COUNT, 3, 3))
    return Estimate(
        3 + 0.5 * np.arange(COUNT),
        rng.normal(size=(COUNT, 3)),
        root @ root.swapaxes(1, 2),
        np.full(COUNT, OK, np.int8),
        rng.normal(size=len(PAIR_LAYOUT.constants)),
        NoiseModel(),
    )


@given(st.floats(3, 4.5))
def test_estimate_is_interpolated_linearly_between_keyframes(time_s: float) -> None:
    found = draw_estimate()
    xy, spread, status = found.interpolate_at(np.array([time_s]))
    for got, columns in ((xy, found.state[:, :2]), (spread, found.covariance[:, :2, :2])):
        flat = columns.reshape(COUNT, -1).T
        wanted = [np.interp(time_s, found.time_s, column) for column in flat]
        assert got.ravel() == pytest.approx(np.array(wanted))
    assert status.tolist() == [OK]


def test_estimate_is_held_and_unconverged_outside_the_flight() -> None:
    found = replace(draw_estimate(), status=np.array([OK, OK, AMBIGUOUS, AMBIGUOUS], np.int8))
    xy, _, status = found.interpolate_at(np.array([2.99, 3.0, 3.49, 3.51, 4.5, 4.51]))
    assert status.tolist() == [UNCONVERGED, OK, OK, AMBIGUOUS, AMBIGUOUS, AMBIGUOUS]
    assert xy[[0, 1, 4, 5]] == pytest.approx(found.state[[0, 0, -1, -1], :2])


def test_transform_to_peer_inverts_the_relative_pose() -> None:
    rng = np.random.default_rng(1)
    place, heading = rng.normal(size=(2, 9)) + 1j * rng.normal(size=(2, 9)), rng.normal(size=(2, 9))

    def seen(one: int, other: int) -> np.ndarray:
        xy = (place[other] - place[one]) * np.exp(-1j * heading[one])
        return np.column_stack([xy.real, xy.imag, heading[other] - heading[one]])

    assert transform_to_peer(seen(0, 1)) == pytest.approx(seen(1, 0))


def test_covariance_seen_from_peer_is_transformed_by_the_jacobian() -> None:
    found = draw_estimate(2)
    other = seen_from_peer(found)
    assert other.state == pytest.approx(transform_to_peer(found.state))
    step = 1e-6
    by_state = np.stack(
        [
            (
                transform_to_peer(found.state + step * axis)
                - transform_to_peer(found.state - step * axis)
            )
            / (2 * step)
            for axis in np.eye(3)
        ],
        axis=-1,
    )
    wanted = by_state @ found.covariance @ by_state.swapaxes(1, 2)
    assert other.covariance == pytest.approx(wanted, rel=1e-6, abs=1e-6)


def test_seen_from_peer_swaps_constants() -> None:
    found = draw_estimate(3)
    other = seen_from_peer(found)
    for name in ("gyro_bias", "velocity_scale", "vx_bias", "vy_bias", "height_offset"):
        for side in (0, 1):
            assert other.value(name, side) == found.value(name, 1 - side)
    for name in ("range_offset", "range_scale"):
        assert other.value(name, 0, 1) == found.value(name, 0, 1)
    assert other.value("clock", 1) == -found.value("clock", 1)
    again = seen_from_peer(seen_from_peer(found))
    for field in fields(Estimate):
        if field.name in ("state", "covariance", "constants"):
            assert getattr(again, field.name) == pytest.approx(getattr(found, field.name))
