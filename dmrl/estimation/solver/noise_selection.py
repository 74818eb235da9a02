"""Select the noise model with the highest evidence."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dmrl.estimation.solver.keyframes import Noise, Problem
from dmrl.estimation.solver.levenberg_marquardt import ROUGH, Solution, evidence, solve_batch
from dmrl.estimation.solver.residuals import OWN_GYRO, PEER_GYRO, linearise

_Z = np.linspace(-8.0, 8.0, 1601)
"""Quadrature points of a standard normal distribution, in standard deviations."""
GRADES = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8)
"""Scales of the velocity noise that are tried, relative to the default model. No record of how the
values were chosen."""
TAKEN = (
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
SHARP, DOUBT = 0.09, 2.0
"""Standard deviation of the log scale that 100 s determine; and penalty of shorter flights.

The scale of a less certain flight is raised by the penalty times the excess of its standard
deviation. Flights of 20 s determine the log scale to 0.2. Those that looked calibrated by chance
were accepted throughout, with a tenth of the labels bad."""

FADING_M, FADING_S = (0.03, 0.06), 1.0
"""Standard deviations of correlated range errors that are tried, metres, and their correlation
time, seconds. Chosen on ranges between ground robots: reflections or antennas made errors of 0.1 m
that lasted one or two seconds."""
GRADED = "velocity_std_mps", "velocity_white_psd", "velocity_scale_std", "scale_std", "bias_std_m"
"""Fields that one flight can hardly separate from correlated range errors. They become the
geometric mean of the values with and without such errors. Heights over a table looked like them."""
OFF, UNMEASURED = 5.0, (0.25, 0.1)
"""A yaw rate bias of this many standard deviations marks an uncalibrated robot; and the priors that
it then gets, of the range offset, metres, and of the velocity scales. Added for simulated short
flights with several sensors off, which were accepted and wrong."""
SURE, TAILED = 15.0, 2.0
"""Log evidence that correlated range errors must gain, as clean ranges show some; and factor of
their standard deviation. With a Cauchy loss, half of the spread of the steps is in its tails. No
other record of how the values were chosen."""
NOISIER, NOTICED = 4, 1.1
"""Largest number of updates of the range noise, and the smallest ratio that leads to another solve.
Each solve hides less of the range errors in the solution. No record of how the values were chosen.
"""
CORRELATED_S, SOME, FAR = 1.0, 4, 2.0
"""Averaging of range residuals: time, seconds; fewest ranges; residual with half weight, in sigmas.

A residual much further off counts next to nothing. Otherwise outliers on one side would look like
correlated noise: flights with 25 % outliers lost all labels, of which 99 % are good."""
ONE = float(np.average((_Z / (1 + (_Z / FAR) ** 2)) ** 2, weights=np.exp(-(_Z**2) / 2)))
"""Mean square of nominal residuals after the weighting by the outlier limit."""


def noise_of(flight: Problem, noise: Noise, solution: Solution) -> tuple[Noise, Solution]:
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
    found, number, likely, solution = _graded(flight, noise, solution)
    found = _unmeasured(found, solution)
    tried: list[tuple[float, float, Solution]] = []
    for std_m in FADING_M:
        fading = _fading(noise, std_m).graded(GRADES[number])
        before = solution.state, solution.constants
        solved = solve_batch(flight, fading, *before, tolerance=ROUGH)
        tried.append((evidence(flight, fading, solved), std_m, solved))
    best, std_m, solved = max(tried, key=lambda one: one[0])
    if best < likely + SURE:
        return found, solution
    faded, _, _, solution = _graded(flight, _fading(noise, TAILED * std_m), solved)
    halves = {name: float(np.sqrt(getattr(found, name) * getattr(faded, name))) for name in GRADED}
    return replace(faded, **halves, known_std=faded.known_std), solution


def _unmeasured(noise: Noise, solution: Solution) -> Noise:
    """Return the noise model with wider priors if a yaw rate bias shows uncalibrated sensors."""
    turns = np.abs(solution.constants[[OWN_GYRO, PEER_GYRO]]) / noise.prior_std()[OWN_GYRO]
    if turns.max() < OFF:
        return noise
    offset_m, scale = UNMEASURED
    return replace(
        noise,
        bias_std_m=max(noise.bias_std_m, offset_m),
        velocity_scale_std=max(noise.velocity_scale_std, scale),
    )


def _fading(noise: Noise, std_m: float) -> Noise:
    """Return the noise model with range errors that are correlated over a second."""
    return replace(noise, range_error_std_m=std_m, range_tau_s=FADING_S, free_weight=0.0)


def _graded(
    flight: Problem, noise: Noise, solution: Solution
) -> tuple[Noise, int, float, Solution]:
    """Search the scale of the velocity noise with the highest evidence.

    Returns
    -------
    noise, index, evidence, solution
        Scaled noise model; the best of ``NOISE_SCALES``, its log evidence and its solution.
    """
    tried: dict[int, float] = {}
    solved: dict[int, Solution] = {}
    middle, last = 2, len(GRADES) - 2
    while True:
        for number in range(middle + 1, middle - 2, -1):
            if number not in tried:
                graded = noise.graded(GRADES[number])
                before = solution.state, solution.constants
                solution = solve_batch(flight, graded, *before, tolerance=ROUGH)
                tried[number], solved[number] = evidence(flight, graded, solution), solution
        best = max(tried, key=lambda number: tried[number])
        if min(max(best, 1), last) == middle:
            break
        middle = min(max(best, 1), last)
    around = range(middle - 1, middle + 2)
    likely = _likely([GRADES[n] for n in around], [tried[n] for n in around]) or GRADES[best]
    velocity, scales, offset_m = (float(np.interp(likely, TAKEN[0], taken)) for taken in TAKEN[1:])
    found = replace(noise.graded(velocity, scales), bias_std_m=offset_m)
    return found, best, tried[best], solved[best]


def _likely(grades: Sequence[float], found: Sequence[float]) -> float | None:
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
    blunter = max((-2 * bend) ** -0.5 - SHARP, 0.0)
    return float(np.exp(min(-slope / (2 * bend) + DOUBT * blunter, np.log(TAKEN[0][-1]))))


def with_range_noise(flight: Problem, noise: Noise, solution: Solution) -> tuple[Noise, Solution]:
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
    for _ in range(NOISIER):
        solution = solve_batch(flight, noise, solution.state, solution.constants)
        times = excess(flight, noise, solution)
        if times < NOTICED:
            break
        noise = noise.with_range_noise(times)
    return noise, solution


def excess(flight: Problem, noise: Noise, solution: Solution) -> float:
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
    residual = linearise(flight, noise, solution.state, solution.constants).range
    second = ((flight.key_s[flight.range_key] - flight.key_s[0]) / CORRELATED_S).astype(int)
    count = np.bincount(second)
    counted = residual / (1 + (residual / FAR) ** 2)
    total = np.bincount(second, counted)[count >= SOME]
    variance = (total**2 / count[count >= SOME]).mean() / ONE if len(total) else 1.0
    return float(np.sqrt(max(variance, 1.0)))
