"""Joint solve of mount and path errors, compared with dense equations and shifted paths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from dmrl.estimation.calibration import mount_solver
from dmrl.estimation.calibration.extrinsics import (
    MAX_MISFIT_EXCESS,
    MAX_REFINED,
    SAME_DELAY_S,
    _Candidate,
    _fit_independent,
    _select_distinct,
)
from dmrl.estimation.calibration.mount_solver import (
    CAUCHY_SIGMAS,
    CONSTANT_SHARE,
    CONSTANT_TILT_SHARE,
    DECAY_S,
    DECAYING_SHARE,
    KNOT_SPACING_S,
    ROTATION_SHARE,
    WEAK_INFORMATION,
    _cauchy_cost,
    _error_axes,
    _linearize_paths,
    _markov_information,
    _solve_step,
    _stack_errors,
    pixel_jacobian,
    solve_mount,
)
from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.calibration.observations import (
    Matches,
    PeerView,
    match_detections,
    pixel_residuals,
    predict_pixels,
    with_mount,
)
from dmrl.geometry.frames import AIDECK, Array

from .test_extrinsics import TRUE, simulate_calibration_flight

VALUES = np.array([*TRUE.mount_rad, TRUE.delay_s])
NOISE = Noise(3.0, 0.02)


def build_views(images: int = 30) -> tuple[list[PeerView], Matches]:
    """Return three flights of a peer, of which the second has no detections, and the matches."""
    spread = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.002], [0.0, 0.002, 0.01]])
    views: list[PeerView] = []
    for seed in range(3):
        one = simulate_calibration_flight(seed, images=images, outliers=0.0)
        path = one.peers["cf2"]
        wide = np.broadcast_to((1 + 0.2 * seed) * spread, path.covariance.shape)
        views.append((one, replace(path, covariance=wide)))
    views[1] = (replace(views[1][0], image=views[1][0].image[:0], uv=np.zeros((0, 2))), views[1][1])
    return views, match_detections(views, TRUE, 40.0, NOISE)


VIEWS, MATCHED = build_views()


def test_pixel_jacobian_equals_finite_differences() -> None:
    found = pixel_jacobian(VIEWS, AIDECK, MATCHED, VALUES)
    assert found.shape == (len(MATCHED.time_s), 2, 4)
    for k in range(4):
        step = 1e-5 * np.eye(4)[k]
        ahead, behind = (
            pixel_residuals(VIEWS, AIDECK, MATCHED, VALUES + s * step) for s in (1, -1)
        )
        slope = (behind - ahead) / 2e-5  # a residual is the detection minus the prediction
        assert found[:, :, k] == pytest.approx(slope, rel=0.02, abs=0.02 * np.abs(slope).max())


def test_error_axes_are_along_and_across_the_line_of_sight_and_up() -> None:
    xyz = np.array([[3.0, 4.0, 1.0], [-2.0, 0.0, -0.5], [0.03, 0.04, 1.0]])
    spread = np.array([np.diag([0.04, 0.09, 0.01]) + 0.01] * 3)
    axes, turn = _error_axes(xyz, spread)
    ways = np.array(
        [[[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]], [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]]
    )
    for k in range(2):
        for column, way in enumerate(ways[k]):
            std = (way @ spread[k] @ way) ** 0.5
            assert axes[k, :, column] == pytest.approx(std * way, abs=1e-6)
    level = np.array([5.0, 2.0, 0.1])  # a peer straight above has no bearing
    sideways = np.array([[-0.8, 0.6, 0], [0, -1, 0], [-0.4, 0.3, 0]])
    across = np.sqrt(np.einsum("ni,nij,nj->n", sideways, spread, sideways))
    assert axes[:, :, 1] == pytest.approx(across[:, None] * sideways, abs=1e-6)
    assert turn * across == pytest.approx(ROTATION_SHARE**0.5 * np.median(across / level) * level)


def test_knots_have_an_exponential_markov_prior() -> None:
    covariance = np.linalg.inv(_markov_information(6).toarray())
    away_s = KNOT_SPACING_S * np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
    assert covariance == pytest.approx(np.exp(-away_s / DECAY_S))


def test_path_error_jacobian_equals_finite_differences() -> None:
    paths = _linearize_paths(VIEWS, TRUE, MATCHED, VALUES)
    assert [path.flight for path in paths] == [0, 1]  # the flight without detections is left out
    for path, number in zip(paths, (0, 2), strict=True):
        one, peer = VIEWS[number]
        assert (MATCHED.view[path.rows] == number).all()
        time_s, camera = MATCHED.time_s[path.rows], with_mount(TRUE, VALUES)
        before, _ = predict_pixels(one, camera, peer, time_s)
        axes, turn = _error_axes(peer.xyz_m, peer.covariance)
        size = 1e-3
        moves = [size * np.sqrt(CONSTANT_SHARE[k]) * axes[:, :, k] for k in range(3)]
        moves += [size * turn[:, None] * axes[:, :, 1]]
        for column, move in enumerate(moves):
            moved = replace(peer, xyz_m=peer.xyz_m + move)
            shift = (predict_pixels(one, camera, moved, time_s)[0] - before).ravel() / size
            shown = path.errors[:, [column]].toarray().ravel()
            assert shown == pytest.approx(shift, abs=0.06 * np.abs(shift).max())
        # The sum over all knots is a constant shift across the line of sight.
        moved = replace(peer, xyz_m=peer.xyz_m + size * np.sqrt(DECAYING_SHARE) * axes[:, :, 1])
        shift = (predict_pixels(one, camera, moved, time_s)[0] - before).ravel() / size
        every = path.errors[:, 4:].sum(axis=1)
        assert every == pytest.approx(shift, abs=0.06 * np.abs(shift).max())
        for k in range(2):
            tilted = replace(one, attitude_rad=one.attitude_rad + size * np.eye(2)[k])
            shift = (predict_pixels(tilted, camera, peer, time_s)[0] - before).ravel() / size
            assert path.level[:, k] == pytest.approx(shift, abs=0.06 * np.abs(shift).max())


def test_path_error_is_linear_between_knots() -> None:
    for path in _linearize_paths(VIEWS, TRUE, MATCHED, VALUES):
        since_s = MATCHED.time_s[path.rows] - MATCHED.time_s[path.rows[0]]
        fading = path.errors[:, 4:]
        knots_s = KNOT_SPACING_S * (np.arange(fading.shape[1]) - 1)
        along, even = fading @ knots_s, fading.sum(axis=1)
        assert along == pytest.approx(np.asarray(even).ravel() * np.repeat(since_s, 2))


@pytest.mark.parametrize("held", [False, True])
def test_gauss_newton_step_equals_dense_solve(held: bool) -> None:
    rng = np.random.default_rng(4)
    paths = _linearize_paths(VIEWS, TRUE, MATCHED, VALUES)
    weight = 1 / (CONSTANT_TILT_SHARE * NOISE.attitude_std_rad) ** 2
    shown, prior = _stack_errors(paths, weight)
    sizes = [path.prior.shape[0] for path in paths]
    count = 4 + sum(sizes) + 4
    dense, information = np.zeros((2 * len(MATCHED.uv), count - 4)), np.zeros((count - 4,) * 2)
    for k, path in enumerate(paths):
        own = slice(sum(sizes[:k]), sum(sizes[: k + 1]))
        tilt = slice(count - 8 + 2 * k, count - 6 + 2 * k)
        rows = np.ravel(2 * path.rows[:, None] + [0, 1])
        dense[rows, own], dense[rows, tilt] = path.errors.toarray(), path.level
        information[own, own], information[tilt, tilt] = path.prior.toarray(), weight * np.eye(2)
    assert shown.toarray() == pytest.approx(dense)
    assert prior.toarray() == pytest.approx(information)
    errors = 0.1 * rng.normal(size=count - 4)
    slopes = pixel_jacobian(VIEWS, TRUE, MATCHED, VALUES).reshape(-1, 4)
    if held:
        slopes[:, 3] = 0
    left = pixel_residuals(VIEWS, TRUE, MATCHED, VALUES).ravel() - dense @ errors
    design = np.hstack([slopes, dense])
    far = (left.reshape(-1, 2) ** 2).sum(axis=1) / (CAUCHY_SIGMAS * 3.0) ** 2
    counts = np.repeat(1 / (9.0 * (1 + far)), 2)
    normal = design.T @ (counts[:, None] * design)
    normal[3, 3] += WEAK_INFORMATION
    normal[4:, 4:] += information
    right = design.T @ (counts * left)
    right[4:] -= information @ errors
    covariance, step = _solve_step(csr_array(design), prior, errors, left, 3.0)
    assert step == pytest.approx(np.linalg.solve(normal, right), rel=1e-6, abs=1e-8)
    assert covariance == pytest.approx(np.linalg.inv(normal)[:4, :4], rel=1e-5)


def test_cauchy_cost_is_quadratic_then_logarithmic() -> None:
    assert _cauchy_cost(np.array([1e-4, 3e-4])) == pytest.approx(2e-4, rel=1e-3)
    assert _cauchy_cost(np.array([CAUCHY_SIGMAS**2])) == pytest.approx(
        0.5 * CAUCHY_SIGMAS**2 * np.log(2)
    )


@pytest.mark.heavy
def test_mount_is_solved_with_free_or_fixed_delay_and_misses_add_cost() -> None:
    off = VALUES + np.array([0.01, -0.01, 0.01, 0.02])
    found = solve_mount(VIEWS, TRUE, MATCHED, off, NOISE, 3.0)
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.values - VALUES) < 4 * sigma).all()
    assert (sigma[:3] < 0.2).all() and sigma[3] < 0.05
    assert found.spread_px == pytest.approx(3.0, rel=0.35)
    kept = solve_mount(VIEWS, TRUE, MATCHED, VALUES, NOISE, 3.0, fix_delay=True)
    assert kept.values[3] == VALUES[3] and kept.covariance[3, 3] == pytest.approx(
        1 / WEAK_INFORMATION
    )
    more = replace(MATCHED, expected=MATCHED.expected + 5)
    missed = solve_mount(VIEWS, TRUE, more, off, NOISE, 3.0)
    one = 0.5 * CAUCHY_SIGMAS**2 * np.log1p((MATCHED.radius_px / 3.0 / CAUCHY_SIGMAS) ** 2)
    assert missed.cost - found.cost == pytest.approx(5 * one)
    assert found.cost > 0


def test_mount_cost_is_robust_loss_of_residuals_in_sigmas(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mount_solver, "MAX_ROUNDS", 0)
    every = replace(MATCHED, expected=len(MATCHED.time_s))
    found = solve_mount(VIEWS, TRUE, every, VALUES, NOISE, 5.0)
    square = (pixel_residuals(VIEWS, TRUE, every, VALUES) ** 2).sum(axis=1) / 5.0**2
    assert found.cost == pytest.approx(_cauchy_cost(square))


def test_mount_angles_are_clipped_to_their_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mount_solver, "MAX_VALUES", np.array([0.01, 0.35, 0.35, 0.5]))
    found: Array = solve_mount(VIEWS, TRUE, MATCHED, VALUES, NOISE, 3.0).values
    assert abs(found[0]) <= 0.01


@pytest.mark.heavy
def test_coarse_search_converges_from_a_few_degrees() -> None:
    off = np.array([0.03, -0.03, 0.03, 0.08])
    for sign in (1, -1):
        found = _fit_independent(VIEWS, TRUE, MATCHED, VALUES + sign * off)
        assert np.abs(found - VALUES)[:3].max() < 0.012
        assert abs(found[3] - VALUES[3]) < 0.03


def test_one_candidate_per_delay_is_refined() -> None:
    def one(delay_s: float, misfit: float) -> _Candidate:
        return _Candidate(np.array([0.0, 0, 0, delay_s]), misfit)

    first, same, other, worse = (
        one(0.0, 1.0),
        one(0.99 * SAME_DELAY_S, 1.0),
        one(1.01 * SAME_DELAY_S, 0.99 + MAX_MISFIT_EXCESS),
        one(0.5, 1.01 + MAX_MISFIT_EXCESS),
    )
    assert [try_.values[3] for try_ in _select_distinct([first, same, other, worse])] == [
        0.0,
        1.01 * SAME_DELAY_S,
    ]
    many = [one(k * 0.1, 1.0) for k in range(MAX_REFINED + 2)]
    assert _select_distinct(many) == many[:MAX_REFINED]
