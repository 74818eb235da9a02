"""How good the sensors were: the noise under which a flight is likeliest."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dmrl.estimation.solver.keyframes import Noise, Problem
from dmrl.estimation.solver.levenberg_marquardt import ROUGH, Solution, evidence, solve_batch
from dmrl.estimation.solver.residuals import OWN_GYRO, PEER_GYRO, linearise

_Z = np.linspace(-8.0, 8.0, 1601)
GRADES = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8)
"""Noise against the default's, weighed by how likely each makes the flight."""
TAKEN = (
    (0.41, 0.55, 0.65, 0.80, 2.80),
    (0.55, 0.60, 1.00, 1.00, 3.50),
    (0.80, 0.90, 1.20, 1.20, 3.50),
    (0.08, 0.08, 0.15, 0.15, 0.35),
)
"""The likeliest grade, the grade that velocities are taken for, that of scales, and the standard
deviation of the ranges' offset, metres: who calibrated one sensor will have measured the other.
The likeliest is a fifth too low and scatters by a tenth, so that the flights that look best
would be believed too much: sensors are taken for the default's unless they are clearly better.
A flight shows a scale once at most: real flow with little noise was seen to be 7 % off."""
SHARP, DOUBT = 0.09, 2.0
"""A flight of 100 s tells the logarithm of its grade to this standard deviation. One that tells it
worse is taken for so many times the difference worse: flights of 20 s tell it to 0.2, and those
that looked calibrated by luck were kept from end to end, and wrong."""

FADING_M, FADING_S = (0.03, 0.06), 1.0
"""Errors of ranges that fade, as where reflections or antennas make them: 0.1 m, and gone after one
or two seconds, was seen between robots on the ground. Standard deviations that are tried."""
GRADED = "velocity_std_mps", "velocity_white_psd", "velocity_scale_std", "scale_std", "bias_std_m"
"""What one flight can hardly tell from errors of ranges that fade: taken half-way, as a geometric
mean, between what it would be with them and without. Heights over a table were taken for them."""
OFF, UNMEASURED = 5.0, (0.25, 0.1)
"""A yaw rate that is biased by so many standard deviations was not calibrated, and who did not
calibrate that will not have measured ranges and flow: their offset, metres, and scale."""
SURE, TAILED = 15.0, 2.0
"""So much more evidence, a logarithm, it takes: clean ranges were seen to have some. Steps with
Cauchy's loss leave half of their spread to its tails."""
NOISIER, NOTICED = 4, 1.1
"""So often ranges may turn out noisier, and by how much for another solve: less of what is wrong
with them hides in the solution each time."""
CORRELATED_S, SOME, FAR = 1.0, 4, 2.0
"""Ranges are held against their mean over this time where there are some of them. A residual of so
many standard deviations counts half, one much further off next to nothing: outliers are no noise
that lasts, and on one side they would seem to be."""
ONE = float(np.average((_Z / (1 + (_Z / FAR) ** 2)) ** 2, weights=np.exp(-(_Z**2) / 2)))
"""Mean square of what so counts of residuals that are as large as was believed."""


def noise_of(flight: Problem, noise: Noise, solution: Solution) -> tuple[Noise, Solution]:
    """What the sensors are like: the noise under which the flight is likeliest.

    That of the velocities first; then it is asked whether the ranges' errors fade within a second,
    and if so, how good the velocities are under that. And a solution under a similar noise.

    Parameters
    ----------
    flight
        The flight.
    noise
        A first guess.
    solution
        The flight's solution under that guess.
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
    """The noise where nobody seems to have measured sensors: one is far off, others may be."""
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
    return replace(noise, range_error_std_m=std_m, range_tau_s=FADING_S, free_weight=0.0)


def _graded(
    flight: Problem, noise: Noise, solution: Solution
) -> tuple[Noise, int, float, Solution]:
    """The noise with its likeliest grade; the nearest of ``GRADES``, its evidence and solution."""
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
    """The likeliest grade, or a larger one where the flight tells it badly; None: it has no top.

    Parameters
    ----------
    grades, found
        Three grades around it, and the evidence for each.
    """
    # The top of a parabola. How sharp it is says how exactly the flight tells.
    bend, slope, _ = np.polyfit(np.log(grades), found, 2)
    if bend >= 0:
        return None
    blunter = max((-2 * bend) ** -0.5 - SHARP, 0.0)
    return float(np.exp(min(-slope / (2 * bend) + DOUBT * blunter, np.log(TAKEN[0][-1]))))


def with_range_noise(flight: Problem, noise: Noise, solution: Solution) -> tuple[Noise, Solution]:
    """The same noise with ranges as noisy as their residuals say, and the solution under it.

    Parameters
    ----------
    flight
        The flight.
    noise
        What was found but for the ranges.
    solution
        A solution under a similar noise.
    """
    for _ in range(NOISIER):
        solution = solve_batch(flight, noise, solution.state, solution.constants)
        times = excess(flight, noise, solution)
        if times < NOTICED:
            break
        noise = noise.with_range_noise(times)
    return noise, solution


def excess(flight: Problem, noise: Noise, solution: Solution) -> float:
    """How many times as noisy the ranges are as was believed, over a second.

    A mean of n independent errors has an n-th of their variance. Where reflections stay with the
    robots for a second it has more, and a range tells as much less.

    Parameters
    ----------
    flight, noise
        The flight, and what was believed about its sensors.
    solution
        The flight's solution.
    """
    residual = linearise(flight, noise, solution.state, solution.constants).range
    second = ((flight.key_s[flight.range_key] - flight.key_s[0]) / CORRELATED_S).astype(int)
    count = np.bincount(second)
    counted = residual / (1 + (residual / FAR) ** 2)
    total = np.bincount(second, counted)[count >= SOME]
    variance = (total**2 / count[count >= SOME]).mean() / ONE if len(total) else 1.0
    return float(np.sqrt(max(variance, 1.0)))
