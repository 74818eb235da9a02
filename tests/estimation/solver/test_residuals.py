"""Factors have zero residuals at the truth, and Jacobians equal to finite differences."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Array, BearingMeasurements, Pair, SensorTrack
from dmrl.estimation.solver.equations import total_cost
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.priors import Chain, ConstantPrior
from dmrl.estimation.solver.problem import NoiseModel, Problem
from dmrl.estimation.solver.residuals import (
    Rows,
    Values,
    bearing_factor,
    odometry_factor,
    range_factor,
)
from dmrl.estimation.solver.unknowns import Unknown

TIME_S = np.arange(0, 4.001, 0.01)


def build_track(turn: float, vx: float, vy: float, height: float) -> SensorTrack:
    """Return a log of 4 s whose vx, yaw rate and height oscillate around these values."""
    ones = np.ones(len(TIME_S))
    swing = np.sin(TIME_S)
    return SensorTrack(
        vx * ones + 0.2 * swing, vy * ones, turn + 0.3 * swing, height + 0.1 * swing,
        np.zeros(len(ones), bool),
    )  # fmt: skip


def build_at_dead_reckoning(pair: Pair) -> tuple[Problem, Values]:
    """Return the problem of a pair, and values with both robots on their dead reckoning."""
    problem = build_problem({(0, 1): pair})
    layout, key_s = problem.layout, problem.keyframe_s
    state = np.zeros((len(key_s), layout.width))
    for robot, (x, y, theta) in enumerate(((0.0, 0.0, 0.0), (1.5, 0.7, 0.4))):
        heading, place, _ = problem.robots[robot].path.interpolate_at(key_s)
        mine = layout.pose(robot)
        state[:, mine[:2]] = np.array([x, y]) + place @ rotation_matrix(np.array(theta)).T
        state[:, mine[2]] = theta + heading
    return problem, Values(state, np.zeros(len(layout.constants)))


def locate(values: Values, problem: Problem, robot: int, time_s: Array) -> tuple[Array, Array]:
    """Return (N, 2) positions and (N,) headings of a robot at some times."""
    path, first = problem.robots[robot].path, values.state[0, 3 * robot : 3 * robot + 3]
    heading, place, _ = path.interpolate_at(time_s)
    return first[:2] + place @ rotation_matrix(first[2]).T, first[2] + heading


@cache
def build_flight() -> tuple[Problem, Values]:
    """Return the problem and true values of two robots with exact ranges and detections."""
    own, peer = build_track(0.4, 0.5, -0.2, 1.0), build_track(-0.3, 0.1, 0.4, 1.4)
    ranges_s = np.arange(0.03, 3.99, 0.05)
    bare = Pair(TIME_S, own, peer, ranges_s, np.full(len(ranges_s), 2.0))
    problem, values = build_at_dead_reckoning(bare)
    images_s = np.arange(0.13, 3.9, 0.3)

    def relative(time_s: Array, one: int) -> tuple[Array, Array]:
        (here, heading), (there, _) = (locate(values, problem, k, time_s) for k in (one, 1 - one))
        up = np.interp(time_s, TIME_S, peer.height_m - own.height_m) * (1 - 2 * one)
        return np.column_stack([rotate(rotation_matrix(-heading), there - here), up]), heading

    def seen(one: int) -> BearingMeasurements:
        xyz, _ = relative(images_s, one)
        level = np.hypot(xyz[:, 0], xyz[:, 1])
        polar = np.column_stack(
            [np.arctan2(xyz[:, 1], xyz[:, 0]), np.arctan2(xyz[:, 2], level),
             np.log(np.linalg.norm(xyz, axis=1))]
        )  # fmt: skip
        other = polar + np.array([0.4, 0.3, 0.5])
        bearing = np.stack([other, polar], axis=1)
        return BearingMeasurements(images_s, bearing, np.full(bearing.shape, 0.03))

    exact = np.linalg.norm(relative(ranges_s, 0)[0], axis=1)
    pair = replace(bare, range_m=exact, own_bearings=seen(0), peer_bearings=seen(1))
    return build_at_dead_reckoning(pair)


def perturb(values: Values, seed: int = 0) -> Values:
    """Return values with random errors of 0.01."""
    rng = np.random.default_rng(seed)
    return Values(*(part + 0.01 * rng.standard_normal(part.shape) for part in values))


def check_jacobian(make: Callable[[Values], Rows], values: Values) -> None:
    """Compare every column of the rows with finite differences."""
    at, step = make(values), 1e-6
    size = len(at.columns)
    for key in (0, 7, len(values.state) - 2):
        for part in range(1 + at.steps):
            for place, column in enumerate(at.columns):
                high, low = values.state.copy(), values.state.copy()
                high[key + part, column] += step
                low[key + part, column] -= step
                ends = [make(Values(s, values.constants)).rows[key, ..., -1] for s in (high, low)]
                found = at.rows[key, ..., part * size + place]
                assert found == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-4, rel=1e-5)
    for place, column in enumerate(at.border):
        high, low = values.constants.copy(), values.constants.copy()
        high[column] += step
        low[column] -= step
        ends = [make(Values(values.state, c)).rows[..., -1] for c in (high, low)]
        found = at.rows[..., size * (1 + at.steps) + place]
        assert found == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-4, rel=1e-5)


@pytest.mark.parametrize("robot", [0, 1])
def test_odometry_factor_is_zero_at_truth_with_exact_jacobian(robot: int) -> None:
    problem, values = build_flight()
    layout = problem.layout
    rows = odometry_factor(problem, layout, robot, values)
    assert rows.rows[..., -1] == pytest.approx(0.0, abs=1e-3)
    names = {layout.constants[c][0][0] for c in rows.border}
    assert names == {"gyro_bias", "velocity_scale", "vx_bias", "vy_bias"} | (
        {"clock"} if robot else set()
    )
    check_jacobian(lambda v: odometry_factor(problem, layout, robot, v), perturb(values))


def test_measured_motion_has_the_errors_of_its_sensors() -> None:
    """A scale multiplies the true motion and a bias adds to it, with the right sign and size."""
    problem, values = build_flight()
    layout, noise, steps_s = problem.layout, problem.noise, problem.robots[0].steps_s
    for name, value, column, wanted in (
        ("velocity_scale", 0.1, 0, 0.1 * problem.robots[0].motion.shift_m[:, 0]),
        ("vx_bias", 0.3, 0, 0.3 * steps_s), ("vy_bias", 0.3, 1, 0.3 * steps_s),
        ("gyro_bias", 0.2, 2, 0.2 * steps_s),
    ):  # fmt: skip
        constants = values.constants.copy()
        constants[layout.find(name, 0)] = value
        found = odometry_factor(problem, layout, 0, Values(values.state, constants))
        std = np.sqrt((noise.yaw_rate_psd if column == 2 else noise.velocity_psd) * steps_s)
        assert found.rows[:, column, 0, -1] * std == pytest.approx(wanted, abs=2e-3)
    state = values.state.copy()
    state[:, layout.state_column("velocity_error_y", 1)] = 0.5
    found = odometry_factor(problem, layout, 1, Values(state, values.constants))
    std = np.sqrt(noise.velocity_psd * steps_s)
    assert found.rows[:, 1, 0, -1] * std == pytest.approx(0.5 * steps_s, abs=5e-3)


def test_clock_derivative_shifts_odometry_in_time() -> None:
    problem, values = build_flight()
    by_clock, steps_s = problem.robots[1].clock_derivative, problem.robots[1].steps_s
    # The yaw rate is -0.3 + 0.3 sin t, so the turn per step changes by 0.3 cos t per second.
    expected = steps_s * 0.3 * np.cos(problem.keyframe_s[:-1] + steps_s / 2)
    assert by_clock[2:-2, 2] == pytest.approx(expected[2:-2], abs=2e-3)
    layout, constants = problem.layout, values.constants.copy()
    constants[layout.find("clock", 1)] = 0.1
    late = odometry_factor(problem, layout, 1, Values(values.state, constants))
    std = np.sqrt(problem.noise.yaw_rate_psd * steps_s)[2:-2]
    assert late.rows[2:-2, 2, 0, -1] * std == pytest.approx(-0.1 * by_clock[2:-2, 2], abs=1e-4)


def test_range_factor_is_zero_at_truth_with_exact_jacobian() -> None:
    problem, values = build_flight()
    layout, (link,) = problem.layout, problem.links
    rows = range_factor(problem, layout, link, values)
    assert rows.rows[..., -1] == pytest.approx(0.0, abs=2e-2)
    assert rows.weight.sum() == len(link.range_m)
    check_jacobian(lambda v: range_factor(problem, layout, link, v), perturb(values))
    std = problem.noise.range_std_m
    true_m = link.range_m.mean()
    for name, own, value, wanted in (
        ("range_offset", (0, 1), 0.3, 0.3), ("range_scale", (0, 1), 0.1, 0.1 * true_m),
    ):  # fmt: skip
        constants = values.constants.copy()
        constants[layout.find(name, *own)] = value
        found = range_factor(problem, layout, link, Values(values.state, constants))
        mean = found.rows[..., 0, -1][found.weight > 0].mean() * std
        assert mean == pytest.approx(wanted, abs=5e-3)
    state = values.state.copy()
    state[:, layout.state_column("range_error", 0, 1)] = 0.4
    found = range_factor(problem, layout, link, Values(state, values.constants))
    assert found.rows[..., 0, -1][found.weight > 0].mean() * std == pytest.approx(0.4, abs=5e-3)


def test_range_error_that_follows_distance_has_an_exact_jacobian() -> None:
    problem, values = build_flight()
    bend = Unknown("bend", "1/m", 0.03, "pair", range_power=2)
    bent = replace(problem, table=(*problem.table, bend))
    at = perturb(values._replace(constants=np.append(values.constants, -0.05)))
    check_jacobian(lambda v: range_factor(bent, bent.layout, bent.links[0], v), at)


def test_sights_of_a_range_go_from_the_robot_that_measured_it() -> None:
    """Ranges that the first robot did not measure have the bearing seen from the second."""
    (link,) = build_flight()[0].links
    sent, far = np.linspace(0.0, 1.0, len(link.range_m)), np.ones(len(link.range_m))
    ahead, own, other = np.outer(far, [2.0, 0.0]), 0.1 * far, 0.3 * far
    sights = replace(link, sent=sent).list_sights(2 * far, ahead, own, other)
    assert sights[1.0].sent == pytest.approx(sent)
    assert sights[-1.0].sent == pytest.approx(1 - sent)
    assert sights[1.0].bearing == pytest.approx(-0.1)
    assert np.cos(sights[-1.0].bearing) == pytest.approx(np.cos(np.pi - 0.3))


def test_ranges_at_keyframes_show_no_scale_of_the_motion_between() -> None:
    problem, values = build_flight()
    (link,), layout = problem.links, problem.layout
    scale = layout.find("velocity_scale", 1)
    assert scale in range_factor(problem, layout, link, values).border
    still = replace(link, peer_shift_m=np.zeros_like(link.peer_shift_m))
    assert scale not in range_factor(problem, layout, still, values).border


def test_steps_are_noisy_where_the_grade_of_a_robot_is_raised() -> None:
    problem, _ = build_flight()
    assert not problem.list_noisy_steps().any()
    steps = len(problem.keyframe_s) - 1
    raised = [np.where(np.arange(steps) == at, 2.0, 1.0) for at in (3, 5)]
    robots = [replace(one, grade=grade) for one, grade in zip(problem.robots, raised, strict=True)]
    noisy = replace(problem, robots=tuple(robots)).list_noisy_steps()
    assert np.flatnonzero(noisy).tolist() == [3, 5]


def test_a_measured_height_is_the_true_one_and_its_error() -> None:
    """The peer is 0.4 m higher. If its height reads too high, the true difference is smaller."""
    problem, values = build_flight()
    layout, (link,) = problem.layout, problem.links
    means = []
    for robot in (0, 1):
        constants = values.constants.copy()
        constants[layout.find("height_offset", robot)] = 0.1
        found = range_factor(problem, layout, link, Values(values.state, constants))
        means.append(found.rows[..., 0, -1][found.weight > 0].mean())
    assert means[1] < 0 < means[0]


@pytest.mark.parametrize("side", [0, 1])
def test_bearing_factor_is_zero_at_truth_with_exact_jacobian(side: int) -> None:
    problem, values = build_flight()
    layout, view = problem.layout, problem.views[side]
    rows = bearing_factor(problem, layout, view, values)
    # The second candidate of every image is the peer.
    assert np.abs(rows.rows[..., -1]).max() < 0.2
    assert rows.weight.sum() == pytest.approx(len(view.time_s))
    check_jacobian(lambda v: bearing_factor(problem, layout, view, v), perturb(values))
    names = {layout.constants[c][0] for c in rows.border}
    assert {("camera_azimuth", (side,)), ("height_offset", (1 - side,))} < names
    assert ("camera_azimuth", (1 - side,)) not in names
    for axis, name in enumerate(("camera_azimuth", "camera_elevation", "camera_distance")):
        constants = values.constants.copy()
        constants[layout.find(name, side)] = 0.02
        found = bearing_factor(problem, layout, view, Values(values.state, constants))
        change = (found.rows - rows.rows)[..., axis, -1][rows.weight > 0]
        assert change == pytest.approx(0.02 / 0.03)


def test_outlier_image_has_zero_weight_and_constant_cost() -> None:
    problem, values = build_flight()
    layout, view = problem.layout, problem.views[0]
    costs = []
    for off in (1.0, 1.2):
        lost = replace(view, bearing=view.bearing + np.array([off, 0.0, 0.0]))
        rows = bearing_factor(problem, layout, lost, values)
        assert not rows.rows[..., :-1].any()
        costs.append(rows.cost())
    assert costs[0] == pytest.approx(costs[1])


@pytest.mark.parametrize(("off_rad", "is_lost"), [(0.25, False), (0.33, True)])
def test_an_azimuth_may_be_farther_off_than_its_noise(off_rad: float, is_lost: bool) -> None:
    """The limit is 0.29 rad: five times the combined noise of 0.03 and 0.05 rad."""
    problem, values = build_flight()
    view = problem.views[0]
    off = replace(view, bearing=view.bearing + np.array([off_rad, 0.0, 0.0]))
    rows = bearing_factor(problem, problem.layout, off, values)
    assert bool(rows.rows[..., :-1].any()) != is_lost


def test_rows_take_the_residuals_and_weights_of_another_linearization() -> None:
    problem, values = build_flight()
    here, there = (
        range_factor(problem, problem.layout, problem.links[0], at)
        for at in (values, perturb(values, 2))
    )
    found = here.with_residuals_of(replace(there, weight=there.weight / 2))
    assert found.rows[..., :-1] == pytest.approx(here.rows[..., :-1])
    assert found.rows[..., -1] == pytest.approx(there.rows[..., -1])
    assert found.weight == pytest.approx(there.weight / 2)


def test_simultaneous_images_share_one_weight() -> None:
    problem, _ = build_flight()
    view = problem.views[0]
    assert view.weight == pytest.approx(1.0)
    own, peer = build_track(0.4, 0.5, -0.2, 1.0), build_track(-0.3, 0.1, 0.4, 1.4)
    dense_s = np.arange(0.5, 3.5, 0.06)
    sees = BearingMeasurements(
        dense_s, np.zeros((len(dense_s), 1, 3)), np.ones((len(dense_s), 1, 3))
    )
    pair = Pair(TIME_S, own, peer, np.array([1.0]), np.array([2.0]), own_bearings=sees)
    (many,) = build_problem({(0, 1): pair}).views
    assert many.weight[10:-10] == pytest.approx(1 / 5)


@pytest.mark.heavy
def test_equations_are_the_gradient_of_the_cost() -> None:
    problem, values = build_flight()
    solver = Solver(problem)
    at = perturb(values, 1)
    equations, factors = solver.equations(at)
    assert {type(factor) for factor in factors} == {Rows, Chain, ConstantPrior}
    step = 1e-6
    for column in range(problem.layout.width):
        ends = []
        for way in (1, -1):
            state = at.state.copy()
            state[9, column] += way * step
            ends.append(total_cost(solver.linearize(Values(state, at.constants))))
        slope = (ends[0] - ends[1]) / (2 * step)
        assert equations.gradient[9, column] == pytest.approx(slope, rel=1e-4, abs=1e-2)
    for column in range(len(at.constants)):
        ends = []
        for way in (1, -1):
            constants = at.constants.copy()
            constants[column] += way * step
            ends.append(total_cost(solver.linearize(Values(at.state, constants))))
        slope = (ends[0] - ends[1]) / (2 * step)
        assert equations.globals_gradient[column] == pytest.approx(slope, rel=1e-4, abs=1e-2)


def test_odometry_noise_follows_model_and_dropouts() -> None:
    problem, values = build_flight()
    noise = NoiseModel(velocity_psd=0.01, yaw_rate_psd=0.02, grade=2.0)
    gap_s = np.full(len(problem.robots[0].steps_s), 0.1)
    own = replace(problem.robots[0], dropout_s=gap_s, turn_dropout_s=gap_s)
    loud = replace(problem, noise=noise, robots=(own, problem.robots[1]))
    rows = odometry_factor(loud, problem.layout, 0, values).rows
    plain = odometry_factor(problem, problem.layout, 0, values).rows
    ratio = [plain[0, k, 0, k] / rows[0, k, 0, k] for k in (0, 2)]
    usual, step_s = problem.noise, problem.robots[0].steps_s[0]
    assert ratio[0] ** 2 == pytest.approx(
        (0.01 * 4 * step_s + 0.25 * 0.1) / (usual.velocity_psd * step_s)
    )
    assert ratio[1] ** 2 == pytest.approx(
        (0.02 * step_s + 0.25 * 0.1) / (usual.yaw_rate_psd * step_s)
    )
