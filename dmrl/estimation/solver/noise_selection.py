"""Select the noise model with the highest evidence."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dmrl.estimation.solver.keyframes import KeyframeProblem, NoiseModel
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    MapEstimate,
    laplace_log_evidence,
    solve,
)
from dmrl.estimation.solver.residuals import OWN_GYRO, PEER_GYRO, linearize

_QUADRATURE_POINTS = np.linspace(-8.0, 8.0, 1601)
"""Quadrature points of a standard normal distribution, in standard deviations."""
NOISE_SCALES = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8)
"""Scales of the velocity noise that are tried, relative to the default model. No record of how the
values were chosen."""
SCALE_PRIOR_TABLE = (
    (0.41, 0.55, 0.65, 0.80, 2.80),
    (0.55, 0.60, 1.00, 1.00, 3.50),
    (0.80, 0.90, 1.20, 1.20, 3.50),
    (0.08, 0.08, 0.15, 0.15, 0.35),
)
"""Correction table of the best scale of a flight, four rows of interpolation points.

Rows: the best scale; the scale used for the velocities; the scale used for the prior of the
constant scales; the prior std of the range offset, metres. The best scale is a fifth too low and
scatters by a tenth, so the flights that look best would get too small a covariance. Sensors keep
the default scale unless they are clearly better. Row 3 never falls below 0.8: one flight reveals a
constant scale once at most, and real flow with little noise was measured 7 % off. Row 4: an
operator who calibrated one sensor probably measured the others too."""
EVIDENCE_STD_AT_100_S, SHORT_FLIGHT_PENALTY = 0.09, 2.0
"""Standard deviation of the log scale that 100 s determine; and penalty of shorter flights.

The scale of a less certain flight is raised by the penalty times the excess of its standard
deviation. Flights of 20 s determine the log scale to 0.2. Those that looked calibrated by chance
were accepted throughout, with a tenth of the labels bad."""

CORRELATED_RANGE_STD_M, RANGE_CORRELATION_S = (0.03, 0.06), 1.0
"""Standard deviations of correlated range errors that are tried, metres, and their correlation
time, seconds. Chosen on ranges between ground robots: reflections or antennas made errors of 0.1 m
that lasted one or two seconds."""
AVERAGED_FIELDS = (
    "velocity_std_mps",
    "velocity_white_psd",
    "velocity_scale_std",
    "scale_std",
    "bias_std_m",
)
"""Fields that one flight can hardly separate from correlated range errors. They become the
geometric mean of the values with and without such errors. Heights over a table looked like them."""
UNCALIBRATED_GYRO_SIGMAS, UNCALIBRATED_STD = 5.0, (0.25, 0.1)
"""A yaw rate bias of this many standard deviations marks an uncalibrated robot; and the priors that
it then gets, of the range offset, metres, and of the velocity scales. Added for simulated short
flights with several sensors off, which were accepted and wrong."""
EVIDENCE_MARGIN, TAIL_FACTOR = 15.0, 2.0
"""Log evidence that correlated range errors must gain, as clean ranges show some; and factor of
their standard deviation. With a Cauchy loss, half of the spread of the steps is in its tails. No
other record of how the values were chosen."""
MAX_RANGE_NOISE_UPDATES, MIN_RANGE_NOISE_RATIO = 4, 1.1
"""Largest number of updates of the range noise, and the smallest ratio that leads to another solve.
Each solve hides less of the range errors in the solution. No record of how the values were chosen.
"""
RANGE_AVERAGING_S, MIN_AVERAGED_RANGES, HALF_WEIGHT_SIGMAS = 1.0, 4, 2.0
"""Averaging of range residuals: time, seconds; fewest ranges; residual with half weight, in sigmas.

A residual much further off counts next to nothing. Otherwise outliers on one side would look like
correlated noise: flights with 25 % outliers lost all labels, of which 99 % are good."""
NOMINAL_MEAN_SQUARE = float(
    np.average(
        (_QUADRATURE_POINTS / (1 + (_QUADRATURE_POINTS / HALF_WEIGHT_SIGMAS) ** 2)) ** 2,
        weights=np.exp(-(_QUADRATURE_POINTS**2) / 2),
    )
)
"""Mean square of nominal residuals after the weighting by the outlier limit."""


def select_noise_model(
    flight: KeyframeProblem, noise: NoiseModel, solution: MapEstimate
) -> tuple[NoiseModel, MapEstimate]:
    """Select the noise model with the highest evidence, and return it with a solution.

    The scale of the velocity noise is searched first. Then the same search runs with range errors
    that are correlated over a second. The solution belongs to a similar noise model.

    Parameters
    ----------
    flight
        Keyframes of the flight.
    noise
        First guess of the noise model.
    solution
        Solution under that guess.
    """
    found, number, likely, solution = _search_scale(flight, noise, solution)
    found = _widen_if_uncalibrated(found, solution)
    tried: list[tuple[float, float, MapEstimate]] = []
    for std_m in CORRELATED_RANGE_STD_M:
        fading = _with_correlated_ranges(noise, std_m).scaled_by(NOISE_SCALES[number])
        before = solution.state, solution.constants
        solved = solve(flight, fading, *before, tolerance=ROUGH_TOLERANCE)
        tried.append((laplace_log_evidence(flight, fading, solved), std_m, solved))
    best, std_m, solved = max(tried, key=lambda one: one[0])
    if best < likely + EVIDENCE_MARGIN:
        return found, solution
    faded, _, _, solution = _search_scale(
        flight, _with_correlated_ranges(noise, TAIL_FACTOR * std_m), solved
    )
    halves = {
        name: float(np.sqrt(getattr(found, name) * getattr(faded, name)))
        for name in AVERAGED_FIELDS
    }
    return replace(faded, **halves, calibrated_std=faded.calibrated_std), solution


def _widen_if_uncalibrated(noise: NoiseModel, solution: MapEstimate) -> NoiseModel:
    """Return the noise model with wider priors if a yaw rate bias shows uncalibrated sensors."""
    turns = np.abs(solution.constants[[OWN_GYRO, PEER_GYRO]]) / noise.prior_std()[OWN_GYRO]
    if turns.max() < UNCALIBRATED_GYRO_SIGMAS:
        return noise
    offset_m, scale = UNCALIBRATED_STD
    return replace(
        noise,
        bias_std_m=max(noise.bias_std_m, offset_m),
        velocity_scale_std=max(noise.velocity_scale_std, scale),
    )


def _with_correlated_ranges(noise: NoiseModel, std_m: float) -> NoiseModel:
    """Return the noise model with range errors that are correlated over a second."""
    return replace(
        noise, range_error_std_m=std_m, range_tau_s=RANGE_CORRELATION_S, range_error_weight=0.0
    )


def _search_scale(
    flight: KeyframeProblem, noise: NoiseModel, solution: MapEstimate
) -> tuple[NoiseModel, int, float, MapEstimate]:
    """Search the scale of the velocity noise with the highest evidence.

    Returns
    -------
    noise, index, evidence, solution
        Scaled noise model; the best of ``NOISE_SCALES``, its log evidence and its solution.
    """
    tried: dict[int, float] = {}
    solved: dict[int, MapEstimate] = {}
    middle, last = 2, len(NOISE_SCALES) - 2
    while True:
        for number in range(middle + 1, middle - 2, -1):
            if number not in tried:
                graded = noise.scaled_by(NOISE_SCALES[number])
                before = solution.state, solution.constants
                solution = solve(flight, graded, *before, tolerance=ROUGH_TOLERANCE)
                tried[number], solved[number] = (
                    laplace_log_evidence(flight, graded, solution),
                    solution,
                )
        best = max(tried, key=lambda number: tried[number])
        if min(max(best, 1), last) == middle:
            break
        middle = min(max(best, 1), last)
    around = range(middle - 1, middle + 2)
    likely = (
        _interpolate_peak([NOISE_SCALES[n] for n in around], [tried[n] for n in around])
        or NOISE_SCALES[best]
    )
    velocity, scales, offset_m = (
        float(np.interp(likely, SCALE_PRIOR_TABLE[0], taken)) for taken in SCALE_PRIOR_TABLE[1:]
    )
    found = replace(noise.scaled_by(velocity, scales), bias_std_m=offset_m)
    return found, best, tried[best], solved[best]


def _interpolate_peak(grades: Sequence[float], found: Sequence[float]) -> float | None:
    """Return the scale at the peak of the evidence, raised if the peak is blunt; None without peak.

    Parameters
    ----------
    grades, found
        Three scales around the peak, and their log evidence.
    """
    # The peak of a parabola. Its curvature gives the standard deviation of the log scale.
    bend, slope, _ = np.polyfit(np.log(grades), found, 2)
    if bend >= 0:
        return None
    blunter = max((-2 * bend) ** -0.5 - EVIDENCE_STD_AT_100_S, 0.0)
    return float(
        np.exp(
            min(
                -slope / (2 * bend) + SHORT_FLIGHT_PENALTY * blunter,
                np.log(SCALE_PRIOR_TABLE[0][-1]),
            )
        )
    )


def fit_range_noise(
    flight: KeyframeProblem, noise: NoiseModel, solution: MapEstimate
) -> tuple[NoiseModel, MapEstimate]:
    """Fit the range noise to the residuals; return the noise model and the solution under it.

    Parameters
    ----------
    flight
        Keyframes of the flight.
    noise
        Noise model with the selected velocity noise.
    solution
        Solution under a similar noise model.
    """
    for _ in range(MAX_RANGE_NOISE_UPDATES):
        solution = solve(flight, noise, solution.state, solution.constants)
        times = range_noise_ratio(flight, noise, solution)
        if times < MIN_RANGE_NOISE_RATIO:
            break
        noise = noise.with_range_noise(times)
    return noise, solution


def range_noise_ratio(flight: KeyframeProblem, noise: NoiseModel, solution: MapEstimate) -> float:
    """Return the ratio of the range noise over a second to its model, at least 1.

    The mean of n independent errors has 1/n of their variance. Reflections that last for a second
    give it more, and the ranges carry correspondingly less information.

    Parameters
    ----------
    flight, noise
        Keyframes of the flight, and the noise model.
    solution
        Solution of the flight.
    """
    residual = linearize(flight, noise, solution.state, solution.constants).range
    second = (
        (flight.keyframe_s[flight.range_keyframe] - flight.keyframe_s[0]) / RANGE_AVERAGING_S
    ).astype(int)
    count = np.bincount(second)
    counted = residual / (1 + (residual / HALF_WEIGHT_SIGMAS) ** 2)
    total = np.bincount(second, counted)[count >= MIN_AVERAGED_RANGES]
    variance = (
        (total**2 / count[count >= MIN_AVERAGED_RANGES]).mean() / NOMINAL_MEAN_SQUARE
        if len(total)
        else 1.0
    )
    return float(np.sqrt(max(variance, 1.0)))
