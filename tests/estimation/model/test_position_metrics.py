"""Metrics of estimated positions, compared with exact cases and direct computations."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from dmrl.estimation.model.position_metrics import (
    DEFINITIONS,
    EvaluatedPositions,
    PairFigures,
    combine_figures,
    compute_figures,
    is_covered_by_truth,
    mahalanobis_squared,
)
from dmrl.geometry.frames import Array


def build_evaluated(
    error_m: Array, std_m: float = 0.1, kept: bool | Array = True
) -> EvaluatedPositions:
    """Return positions of a peer 1.5 m away with these errors, at 10 Hz."""
    count = len(error_m)
    return EvaluatedPositions(
        time_s=np.arange(count) / 10,
        error_m=error_m,
        covariance=np.tile(np.eye(2) * std_m**2, (count, 1, 1)),
        distance_m=np.full(count, 1.5),
        kept=np.broadcast_to(np.asarray(kept), count).copy(),
    )


def test_consistent_estimator_has_nees_2_and_coverage_95_percent() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[0.04, 0.015], [0.015, 0.01]])
    errors = rng.multivariate_normal(np.zeros(2), covariance, 20_000)
    honest = build_evaluated(errors)
    honest = EvaluatedPositions(
        honest.time_s,
        errors,
        np.tile(covariance, (20_000, 1, 1)),
        honest.distance_m,
        honest.kept,
    )
    found = compute_figures(honest, 0.0)
    assert found.nees == pytest.approx(2.0, rel=0.03)
    assert found.coverage_95 == pytest.approx(0.95, abs=0.005)
    assert found.rmse_m == pytest.approx(np.sqrt(0.05), rel=0.02)


def test_errors_before_settling_affect_gate_figures_only() -> None:
    errors = np.zeros((100, 2))
    errors[:50, 0] = 5.0
    kept = np.arange(100) >= 40
    found = compute_figures(build_evaluated(errors, kept=kept), settle_s=5.0)
    assert (found.rmse_m, found.p95_m, found.wrong_basin, found.nees) == (0.0, 0.0, 0.0, 0.0)
    assert (found.kept, found.good) == (0.6, 0.5)
    assert found.precision == pytest.approx(50 / 60)
    assert found.recall == 1.0
    assert found.kept_rmse_m == pytest.approx(5 * np.sqrt(10 / 60))


def test_a_mirrored_solution_is_a_wrong_basin() -> None:
    found = compute_figures(build_evaluated(np.tile([0.0, 2.0], (100, 1))), 0.0)
    assert found.wrong_basin == 1.0
    assert compute_figures(build_evaluated(np.tile([0.0, 0.5], (100, 1))), 0.0).wrong_basin == 0.0


def test_covariances_that_are_unknown_or_exact_are_not_judged() -> None:
    for std_m in (0.0, np.nan):
        found = compute_figures(build_evaluated(np.full((10, 2), 0.1), std_m), 0.0)
        assert np.isnan(found.nees)
        assert np.isnan(found.coverage_95)
        assert found.kept == 1.0


def test_metrics_without_data_are_nan() -> None:
    found = compute_figures(build_evaluated(np.ones((10, 2)), kept=False), settle_s=100.0)
    assert np.isnan([found.rmse_m, found.wrong_basin, found.precision, found.recall]).all()
    assert np.isnan(combine_figures([found]).precision)


def test_over_all_pairs_every_sample_counts_once() -> None:
    one = compute_figures(build_evaluated(np.zeros((100, 2))), 0.0)
    other = compute_figures(build_evaluated(np.full((300, 2), 0.5), kept=np.arange(300) < 60), 0.0)
    none = compute_figures(build_evaluated(np.zeros((100, 2)), kept=False), 0.0)
    every = combine_figures([one, other, none])
    assert every.samples == 500
    assert every.kept == pytest.approx(160 / 500)
    assert every.precision == pytest.approx(100 / 160)
    assert every.recall == pytest.approx(100 / 200)
    assert every.rmse_m == 0.0


def test_every_figure_is_defined() -> None:
    assert set(DEFINITIONS) == set(PairFigures.__dataclass_fields__) - {"samples"}


def test_truth_covers_times_between_dense_samples() -> None:
    true_ns = np.array([0, 200, 450, 701, 1000]) * 1_000_000  # gaps of 0.2, 0.25, 0.251, 0.299 s
    at_ns = np.array([-1, 0, 100, 200, 300, 450, 500, 701, 900, 1000, 1001]) * 1_000_000
    near = [False, True, True, True, True, True, False, True, False, True, False]
    assert is_covered_by_truth(at_ns, true_ns).tolist() == near
    assert not is_covered_by_truth(at_ns, true_ns[:0]).any()


def test_figures_equal_a_direct_computation() -> None:
    rng = np.random.default_rng(5)
    count, settle_s = 101, 3.0  # one sample is exactly at 3 s, and counts
    root = rng.normal(size=(count, 2, 2)) * 0.2
    found = EvaluatedPositions(
        np.arange(count) / 10,
        rng.normal(size=(count, 2)) * 0.25,
        root @ root.swapaxes(1, 2),
        rng.uniform(1, 2, count),
        rng.random(count) < 0.6,
    )
    size = [float(np.hypot(x, y)) for x, y in found.error_m]
    squared = [
        float(e @ np.linalg.solve(c, e))
        for e, c in zip(found.error_m, found.covariance, strict=True)
    ]
    late = [k for k in range(count) if found.time_s[k] >= settle_s]
    kept = [k for k in range(count) if found.kept[k]]
    good = [k for k in range(count) if size[k] <= 0.3]
    both = len(set(kept) & set(good))
    wanted = {
        "samples": count,
        "rmse_m": np.sqrt(np.mean([size[k] ** 2 for k in late])),
        "p95_m": np.percentile([size[k] for k in late], 95),
        "wrong_basin": 0.0,
        "nees": np.mean([squared[k] for k in late]),
        "coverage_95": np.mean([squared[k] <= 5.991 for k in late]),
        "good": len(good) / count,
        "kept": len(kept) / count,
        "precision": both / len(kept),
        "recall": both / len(good),
        "kept_coverage_95": np.mean([squared[k] <= 5.991 for k in kept]),
        "kept_rmse_m": np.sqrt(np.mean([size[k] ** 2 for k in kept])),
    }
    assert asdict(compute_figures(found, settle_s)) == pytest.approx(wanted)
    assert found.sigma_m == pytest.approx(np.sqrt([np.diag(c) for c in found.covariance]))


@pytest.mark.parametrize(("share", "wrong"), [(0.49, 0.0), (0.51, 1.0)])
def test_median_error_over_half_the_distance_is_a_wrong_basin(share: float, wrong: float) -> None:
    errors = np.tile([0.0, 1.5 * share], (9, 1))
    assert compute_figures(build_evaluated(errors), 0.0).wrong_basin == wrong
    errors[:4] = 1.5 * (1 - share)  # fewer than half of the samples do not change the median
    assert compute_figures(build_evaluated(errors), 0.0).wrong_basin == wrong


@pytest.mark.parametrize(
    "covariance",
    [[[1, 1], [1, 1]], [[-1, 0], [0, -1]], [[-1, 0], [0, 1]], [[0, 0], [0, 1]], [[1, 2], [2, 1]]],
)
def test_invalid_covariance_gives_nan_mahalanobis_distance(covariance: list[list[float]]) -> None:
    one = replace(build_evaluated(np.array([[1.0, 0.0]])), covariance=np.array([covariance], float))
    assert np.isnan(mahalanobis_squared(one)).all()


def test_figures_over_all_pairs_are_means_medians_or_shares() -> None:
    def pair(k: float, samples: int) -> PairFigures:
        return PairFigures(samples, k, 2 * k, k, 3 * k, k / 4, 0.5, k / 3, 0.5, k / 3, k / 5, 4 * k)

    one, two, nan = pair(0.3, 100), pair(0.9, 300), PairFigures(50, *[float("nan")] * 5, *[0.0] * 2,
                                                           *[float("nan")] * 4)  # fmt: skip
    found = combine_figures([one, two, nan])
    assert found.samples == 450
    assert (found.rmse_m, found.p95_m, found.kept_rmse_m) == pytest.approx((0.6, 1.2, 2.4))
    assert (found.wrong_basin, found.nees) == pytest.approx((0.6, 1.8))
    assert (found.coverage_95, found.kept_coverage_95) == pytest.approx((0.15, 0.12))
    good, kept = 0.5 * 400, 0.1 * 100 + 0.3 * 300
    both = 50 * 0.1 + 150 * 0.3
    assert (found.good, found.kept) == pytest.approx((good / 450, kept / 450))
    assert (found.precision, found.recall) == pytest.approx((both / kept, both / good))
