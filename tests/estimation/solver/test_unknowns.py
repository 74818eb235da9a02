"""The table of unknowns, from which layout, priors and sensor files are derived."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.pair_solver import solve_pair
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.layout import build_layout, from_peer
from dmrl.estimation.solver.levenberg_marquardt import relative_path
from dmrl.estimation.solver.problem import NoiseModel, RangeLink, Sight
from dmrl.estimation.solver.robust_loss import Cauchy, Gaussian
from dmrl.estimation.solver.unknowns import SIGHTED, TABLE, Unknown, with_rows, without_rows
from dmrl.labelling.sensor_file import OF_PAIR, OF_ROBOT, SCALES

from ..flights import build_pair, simulate_flight

ROWS = {row.name: row for row in TABLE}
PRIORS = {
    "range_offset": (0.15, "m", "pair", "range_offset_m"),
    "range_scale": (0.02, "1", "pair", "range_scale"),
    "gyro_bias": (0.003, "rad/s", "robot", "yaw_rate_bias_radps"),
    "velocity_scale": (0.05, "1", "robot", "velocity_scale"),
    "vx_bias": (0.02, "m/s", "robot", "vx_bias_mps"),
    "vy_bias": (0.02, "m/s", "robot", "vy_bias_mps"),
    "clock": (0.02, "s", "clock", ""),
    "height_offset": (0.03, "m", "robot", ""),
}
EVOLUTIONS = {
    "velocity_error_x": ("fading", 0.08, 0.3),
    "velocity_error_y": ("fading", 0.08, 0.3),
    "range_error": ("jump", 0.002, np.inf),
    "height_error": ("fading", 0.03, 4.0),
}


LOSSES = {
    "range_offset": Cauchy(1.5), "gyro_bias": Cauchy(2.0), "clock": Cauchy(2.0),
    "velocity_error_x": Cauchy(5.0), "velocity_error_y": Cauchy(5.0), "range_error": Cauchy(1.0),
    "camera_azimuth": Cauchy(2.0), "camera_distance": Cauchy(2.0),
}  # fmt: skip


def test_rows_that_may_be_far_off_have_wide_tails() -> None:
    assert {r.name: r.loss for r in TABLE if r.loss != Gaussian()} == LOSSES
    (jump,) = (r for r in TABLE if r.pull_weight)
    known = jump.name, jump.start_std, jump.pull_std, jump.pull_weight
    assert known == ("range_error", 0.02, 0.05, 0.04)


def test_rows_have_the_units_and_priors_of_their_sensors() -> None:
    found = {r.name: (r.std, r.unit, r.owner, r.key) for r in TABLE if r.is_constant}
    assert {name: found[name] for name in PRIORS} == PRIORS
    states = {r.name: (r.evolution, r.std, r.time_s) for r in TABLE if not r.is_constant}
    assert states == EVOLUTIONS
    graded = {row.name for row in TABLE if row.graded}
    assert graded == {
        "range_offset", "range_scale", "velocity_scale", "velocity_error_x", "velocity_error_y",
    }  # fmt: skip


def test_the_sensor_file_has_the_rows_with_a_key() -> None:
    assert {key: n for n, (_, _, own, key) in PRIORS.items() if key and own == "robot"} == OF_ROBOT
    assert {key: n for n, (_, _, own, key) in PRIORS.items() if key and own == "pair"} == OF_PAIR
    assert set(SCALES) == {"range_scale", "velocity_scale"}


def test_layout_has_one_column_per_owner() -> None:
    layout = build_layout(TABLE, 3, [(0, 1), (1, 2)])
    subjects = [subject for subject, _ in layout.constants]
    assert [own for name, own in subjects if name == "range_offset"] == [(0, 1), (1, 2)]
    assert [own for name, own in subjects if name == "gyro_bias"] == [(0,), (1,), (2,)]
    # The clock of the first robot is the reference, so it has no unknown.
    assert [own for name, own in subjects if name == "clock"] == [(1,), (2,)]
    assert not {name for name, _ in subjects} & set(SIGHTED)
    assert layout.width == 9 + 2 * 3 + 2
    assert layout.state_column("range_error", 1, 2) == layout.width - 1
    assert layout.state_column("range_error", 0, 2) is None
    sighted = build_layout(TABLE, 2, [(0, 1)], (0,), {("range_error", (0, 1))})
    assert ("camera_azimuth", (0,)) in [subject for subject, _ in sighted.constants]
    assert ("camera_azimuth", (1,)) not in [subject for subject, _ in sighted.constants]
    assert sighted.state_column("range_error", 0, 1) is None
    assert sighted.state_column("height_error", 0) is not None
    with pytest.raises(KeyError):
        layout.find("range_offset", 0, 2)


def test_flight_unknown_applies_once_to_each_measurement() -> None:
    shared = Unknown("all", "m", 0.1, "flight", range=ROWS["range_offset"].range)
    layout = build_layout((shared,), 2, [(0, 1)])
    assert [row.name for row, *_ in layout.measured((0, 1), "range")] == ["all"]


def test_from_peer_swaps_constants_and_negates_clocks() -> None:
    layout = build_layout(TABLE, 2, [(0, 1)])
    values = np.arange(1.0, 1 + len(layout.constants))
    other = from_peer(layout, values)
    for k, ((name, own), _) in enumerate(layout.constants):
        if name == "clock":
            assert other[k] == -values[k]
        elif len(own) == 2:
            assert other[k] == values[k]
        else:
            assert other[k] == values[layout.find(name, 1 - own[0])]
    assert from_peer(layout, other) == pytest.approx(values)


def test_known_and_scaled_priors_follow_the_noise_model() -> None:
    layout = build_layout(TABLE, 2, [(0, 1)])
    noise = NoiseModel(constants_grade=2.0, known_std={("gyro_bias", (1,)): 1e-4})
    std = noise.prior_std(layout)
    assert std[layout.find("range_offset", 0, 1)] == 0.3
    assert std[layout.find("vx_bias", 0)] == 0.02
    assert std[layout.find("gyro_bias", 0)] == 0.003
    assert std[layout.find("gyro_bias", 1)] == 1e-4


def test_step_model_follows_evolution_of_the_unknown() -> None:
    steps_s = np.array([0.01, 0.2, 100.0])
    fading = Unknown("a", "m", 0.08, "robot", evolution="fading", time_s=0.3)
    kept, std = fading.step_model(steps_s)
    # Ornstein-Uhlenbeck: the variance grows by 2 std^2 / tau per second, up to std^2.
    assert kept == pytest.approx(np.exp(-steps_s / 0.3))
    assert std[0] ** 2 == pytest.approx(2 * 0.08**2 * 0.01 / 0.3, rel=0.05)
    assert std[2] == pytest.approx(0.08)
    kept, std = replace(fading, evolution="walk").step_model(steps_s)
    assert (kept == 1).all() and std == pytest.approx(0.08 * np.sqrt(steps_s))


def test_rows_are_replaced_by_name_and_removed() -> None:
    wide = replace(ROWS["clock"], std=1.0)
    assert with_rows(TABLE, wide)[TABLE.index(ROWS["clock"])].std == 1.0
    assert len(with_rows(TABLE, wide)) == len(TABLE)
    assert "clock" not in [row.name for row in without_rows(TABLE, ("clock",))]


def _compute_drift(link: RangeLink, sight: Sight) -> Array:
    """Return the effect of a linear range drift over 40 s."""
    return np.asarray((link.time_s - 20.0) / 20.0) + 0 * sight.distance


@pytest.mark.heavy
def test_a_new_unknown_is_one_row_in_a_copy_of_the_table() -> None:
    """A drift of the ranges is estimated after adding one row to the table."""
    flight = simulate_flight("random", "calibrated", 1001, 40.0)
    pair = build_pair(flight)
    drift_m = 0.5
    late = replace(pair, range_m=pair.range_m + drift_m * (pair.range_time_s - 20.0) / 20.0)
    row = Unknown("range_drift", "m", 0.5, "pair", range=_compute_drift)
    problem = build_problem({(0, 1): late})
    found = solve_pair(replace(problem, table=with_rows(TABLE, row)))
    layout = found.problem.layout
    assert found.values.constants[layout.find("range_drift", 0, 1)] == pytest.approx(
        drift_m, abs=0.2
    )
    sound = solve_pair(build_problem({(0, 1): pair}))
    apart = relative_path(found.values.state) - relative_path(sound.values.state)
    assert np.sqrt((apart[:, :2] ** 2).sum(axis=1).mean()) < 0.1


@pytest.mark.heavy
def test_the_order_of_the_rows_does_not_matter() -> None:
    problem = build_problem(
        {(0, 1): build_pair(simulate_flight("random", "calibrated", 1001, 20.0))}
    )
    one, other = (
        solve_pair(replace(problem, table=table), NoiseModel(grade=0.63))
        for table in (TABLE, TABLE[::-1])
    )
    paths = [relative_path(found.values.state) for found in (one, other)]
    assert np.abs(paths[0] - paths[1]).max() < 0.01
