from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver import noise_selection
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, KeyframeProblem, NoiseModel
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate
from dmrl.estimation.solver.noise_selection import (
    NOISE_SCALES,
    NOMINAL_MEAN_SQUARE,
    RANGE_CORRELATION_S,
    SCALE_PRIOR_TABLE,
    SHORT_FLIGHT_PENALTY,
    UNCALIBRATED_STD,
    range_noise_ratio,
)
from dmrl.flight import NOISE, Fault, Scenario, simulate

from ..flights import flown, pair_of, truth_at


def reflected(pair: Pair, std_m: float, fades_s: float, seed: int) -> Pair:
    """The pair with an error of its ranges that fades, as reflections make it."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-np.diff(pair.range_time_s) / fades_s)
    steps = rng.normal(0.0, std_m, len(pair.range_m))
    steps[1:] *= np.sqrt(1 - kept**2)
    error = [steps[0]]
    for keep, step in zip(kept, steps[1:], strict=True):
        error.append(keep * error[-1] + step)
    return replace(pair, range_m=np.maximum(pair.range_m + np.array(error), 0.05))


@pytest.mark.parametrize("likeliest", [0.6, 1.2, 2.0])
@pytest.mark.parametrize(("std", "doubted"), [(0.05, 0.0), (0.09, 0.0), (0.19, 0.1)])
def test_a_grade_between_those_tried_is_where_the_evidence_peaks(
    likeliest: float, std: float, doubted: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evidence is a parabola of the grade's logarithm: its top is found exactly.

    A flight that tells it worse than one of 100 s does is taken for a worse one.
    """

    def likely(_: KeyframeProblem, noise: NoiseModel, __: MapEstimate) -> float:
        grade = noise.velocity_std_mps / NoiseModel().velocity_std_mps
        return float(-((np.log(grade) - np.log(likeliest)) ** 2) / (2 * std**2))

    some = MapEstimate(np.zeros((1, 6)), np.zeros(len(GLOBALS)), 0.0)
    monkeypatch.setattr(noise_selection, "solve", lambda *_, **__: some)
    monkeypatch.setattr(noise_selection, "laplace_log_evidence", likely)
    found, nearest, _, _ = noise_selection._search_scale(SimpleNamespace(), NoiseModel(), some)  # type: ignore[arg-type]
    assert NOISE_SCALES[nearest] == min(
        NOISE_SCALES, key=lambda grade: abs(np.log(grade / likeliest))
    )
    taken_for = likeliest * np.exp(SHORT_FLIGHT_PENALTY * doubted)
    velocity, scales, offset_m = (
        np.interp(taken_for, SCALE_PRIOR_TABLE[0], taken) for taken in SCALE_PRIOR_TABLE[1:]
    )
    assert found.velocity_std_mps == pytest.approx(velocity * NoiseModel().velocity_std_mps)
    assert found.velocity_scale_std == pytest.approx(scales * NoiseModel().velocity_scale_std)
    assert found.bias_std_m == pytest.approx(offset_m)


def test_evidence_that_bends_up_or_hardly_at_all_tells_no_grade_that_is_better() -> None:
    assert noise_selection._interpolate_peak((0.4, 0.55, 0.75), (3.0, 1.0, 2.0)) is None
    flat = [-1e-9 * np.log(grade / 0.5) ** 2 for grade in (0.4, 0.55, 0.75)]
    assert noise_selection._interpolate_peak((0.4, 0.55, 0.75), flat) == pytest.approx(
        SCALE_PRIOR_TABLE[0][-1]
    )


@pytest.mark.heavy
def test_errors_of_ranges_that_fade_are_noticed_and_the_ellipse_holds_them() -> None:
    flight = flown("random", "calibrated", 1003, 60.0)
    plain = pair_of(flight)
    both = [plain, reflected(plain, 0.08, 1.0, 5)]
    (clean, _), (found, _) = (estimate_pairs([pair])[0] for pair in both)
    assert clean.noise.range_tau_s > RANGE_CORRELATION_S == found.noise.range_tau_s
    error = found.state[:, :2] - truth_at(flight, found.time_s)
    assert inside(found, error) > 0.85
    kept = found.status == OK
    assert (np.hypot(*error[kept].T) > 0.3).sum() <= 0.05 * kept.sum()


def inside(found: Estimate, error: np.ndarray) -> float:
    """Share of the errors in the 95 % ellipse, after 20 s."""
    information = np.linalg.inv(found.covariance[:, :2, :2])
    squared = np.einsum("ni,nij,nj->n", error, information, error)
    return float((squared[found.time_s > 20.0] < 5.99).mean())


@pytest.mark.parametrize(
    ("alike", "times", "wanted"),
    [(1, 1.0, 1.0), (5, 1.0, 5**0.5), (10, 1.0, 10**0.5), (1, 0.3, 1.0)],
)
def test_errors_that_stay_for_a_second_tell_as_much_less(
    alike: int, times: float, wanted: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten ranges a second, of which so many in a row have one error, this many sigmas large."""
    rng = np.random.default_rng(7)
    seconds = 4000
    residual = np.repeat(rng.normal(0, 1, seconds * 10 // alike), alike)
    key_s = np.arange(seconds * 10) / 10 + 3.0
    flight = SimpleNamespace(keyframe_s=key_s, range_keyframe=np.arange(seconds * 10))
    monkeypatch.setattr(
        noise_selection, "linearize", lambda *_: SimpleNamespace(range=times * residual)
    )
    solution = SimpleNamespace(state=None, constants=None)
    found = range_noise_ratio(flight, NoiseModel(), solution)  # type: ignore[arg-type]
    assert found == pytest.approx(wanted, rel=0.06)


def test_seconds_of_three_ranges_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    for many, found in ((3, 1.0), (4, None)):
        key_s = np.repeat(np.arange(50.0), many) + np.tile(np.arange(many) / 10, 50)
        flight = SimpleNamespace(keyframe_s=key_s, range_keyframe=np.arange(len(key_s)))
        monkeypatch.setattr(
            noise_selection,
            "linearize",
            lambda *_: SimpleNamespace(range=np.full(len(key_s), 2.0)),  # noqa: B023
        )
        solution = SimpleNamespace(state=None, constants=None)
        got = range_noise_ratio(flight, NoiseModel(), solution)  # type: ignore[arg-type]
        assert got == (found or pytest.approx(2.0 / NOMINAL_MEAN_SQUARE**0.5, rel=1e-6))


def test_seconds_are_counted_from_the_flight_s_first_keyframe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Eight ranges a second have one error. A clock that began elsewhere tells the same."""
    residual = np.repeat(np.random.default_rng(9).normal(0, 1, 50), 8)
    monkeypatch.setattr(noise_selection, "linearize", lambda *_: SimpleNamespace(range=residual))
    solution, key = SimpleNamespace(state=None, constants=None), np.arange(len(residual))
    found = set()
    for began in (0.0, 0.5, 77.25):
        flight = SimpleNamespace(keyframe_s=key / 8 + began, range_keyframe=key)
        found.add(range_noise_ratio(flight, NoiseModel(), solution))  # type: ignore[arg-type]
    assert len(found) == 1 and found.pop() > 2


def test_a_yaw_rate_that_is_far_off_tells_that_nobody_measured_the_sensors() -> None:
    """Otherwise a short flight takes the offset of its ranges for a bias that is not there."""
    flight = simulate(
        Scenario(2, 30.0),
        NOISE["calibrated"],
        15000,
        [
            Fault("range_offset", "cf1", "cf2"),
            Fault("yaw_rate_bias", "cf2"),
            Fault("velocity_scale", "cf1"),
        ],
    )
    found = estimate_pairs([pair_of(flight)])[0][0]
    assert found.noise.bias_std_m == pytest.approx(UNCALIBRATED_STD[0])
    assert found.noise.velocity_scale_std >= UNCALIBRATED_STD[1]
    off_m = np.hypot(*(found.state[:, :2] - truth_at(flight, found.time_s)).T)
    assert ((off_m > 0.3) & (found.status == OK)).mean() < 0.05
    usual = estimate_pairs([pair_of(flown("in_view", "calibrated", 15000))])[0][0]
    assert usual.noise.velocity_scale_std < UNCALIBRATED_STD[1]
