"""Positions of peers at 20 Hz and at the images."""

import numpy as np
import pytest

from dmrl.estimation.model.pair import Pair, SensorTrack
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.labelling.peer_positions import sample_positions

SECOND_NS = 1_000_000_000


def test_relative_height_comes_from_the_height_sensors_at_each_time() -> None:
    time_s = np.arange(0, 10, 0.01)
    none, gap = np.zeros(len(time_s)), np.zeros(len(time_s), bool)
    own, peer = (
        SensorTrack(none, none, none, high, gap) for high in (1 + 0 * time_s, 1.5 + 0.1 * time_s)
    )
    pair = Pair(time_s, own, peer, np.array([1.0]), np.array([2.0]))
    state = np.column_stack([2 + time_s[::10], -time_s[::10], 0 * time_s[::10]])
    spread = np.tile(np.diag([0.04, 0.09, 0.01]), (100, 1, 1))
    status = np.zeros(100, np.int8)
    noise = NoiseModel(height_std_m=0.3)
    found = Estimate(time_s[::10], state, spread, status, np.zeros(13), noise)
    start_ns, images_ns = 7 * SECOND_NS + 20_000_000, np.array([5, 8, 99]) * SECOND_NS + 33
    made = sample_positions(start_ns, pair, found, images_ns)
    later_s = (made.time_ns - start_ns) * 1e-9
    assert made.xyz_m == pytest.approx(
        np.column_stack([2 + later_s, -later_s, 0.5 + 0.1 * later_s])
    )
    assert made.covariance[7] == pytest.approx(np.diag([0.04, 0.09, 0.09]))
    regular = np.flatnonzero(made.time_ns % (SECOND_NS // 20) == 0)
    assert sorted(set(range(len(made.time_ns))) - set(regular.tolist())) == [
        int(np.searchsorted(made.time_ns, 8 * SECOND_NS + 33))
    ]
    assert (made.time_ns[0], made.time_ns[-1]) == (7_050_000_000, 16_900_000_000)


def test_an_estimated_height_error_is_removed() -> None:
    time_s = np.arange(0, 10, 0.01)
    none, gap = np.zeros(len(time_s)), np.zeros(len(time_s), bool)
    own, peer = (SensorTrack(none, none, none, high + none, gap) for high in (1.0, 1.5))
    pair = Pair(time_s, own, peer, np.array([1.0]), np.array([2.0]))
    key_s, count = time_s[::10], len(time_s[::10])
    spread, status = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, np.int8)
    error_m, std_m = np.linspace(0.1, 0.3, count), np.full(count, 0.02)
    found = Estimate(
        key_s, np.ones((count, 3)), spread, status, np.zeros(13), NoiseModel(),
        height_m=error_m, height_std_m=std_m,
    )  # fmt: skip
    made = sample_positions(0, pair, found, np.zeros(0, np.int64))
    wanted = 0.5 - np.interp(made.time_ns * 1e-9, key_s, error_m)
    assert made.xyz_m[:, 2] == pytest.approx(wanted, abs=1e-6)
    assert made.covariance[:, 2, 2] == pytest.approx(0.02**2)
