from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.estimate import estimate_pairs
from dmrl.estimation.estimated import Estimate
from dmrl.estimation.gate import OK
from dmrl.estimation.grading import FADING_S
from dmrl.estimation.pair import Pair

from .flights import flown, pair_of, truth_at


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


@pytest.mark.heavy
def test_errors_of_ranges_that_fade_are_noticed_and_the_ellipse_holds_them() -> None:
    flight = flown("random", "calibrated", 1003, 60.0)
    plain = pair_of(flight)
    both = [plain, reflected(plain, 0.08, 1.0, 5)]
    (clean, _), (found, _) = (estimate_pairs([pair])[0] for pair in both)
    assert clean.noise.range_tau_s > FADING_S == found.noise.range_tau_s
    error = found.state[:, :2] - truth_at(flight, found.time_s)
    assert inside(found, error) > 0.85
    kept = found.status == OK
    assert (np.hypot(*error[kept].T) > 0.3).sum() <= 0.05 * kept.sum()


def inside(found: Estimate, error: np.ndarray) -> float:
    """Share of the errors in the 95 % ellipse, after 20 s."""
    information = np.linalg.inv(found.covariance[:, :2, :2])
    squared = np.einsum("ni,nij,nj->n", error, information, error)
    return float((squared[found.time_s > 20.0] < 5.99).mean())
