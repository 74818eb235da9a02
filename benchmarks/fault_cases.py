"""Twenty faults of a flight, and limits on the errors of labels with each."""

from dataclasses import dataclass

import numpy as np

from dmrl.flight import Fault


@dataclass(frozen=True, slots=True)
class Case:
    """Faults of a flight, and limits of the batch solve in addition to the general ones.

    Parameters
    ----------
    faults
        Faults of a flight of 100 s.
    outside_m
        Largest median RMSE outside the windows of the faults, with calibrated noise.
    kept
        Smallest share of kept positions, with calibrated noise.
    """

    faults: tuple[Fault, ...] = ()
    outside_m: float = np.inf
    kept: float = 0.0


def build_bursts(number: int, lasts_s: float) -> tuple[Fault, ...]:
    """Return a fault with some bursts of ranges that are 1 m too long."""
    return (Fault("nlos", "cf1", "cf2", size=1.0, duration_s=lasts_s, number=number),)


CASES = {
    "none": Case((), 0.12, 0.9),
    "1 burst of 3 s": Case(build_bursts(1, 3.0), 0.12, 0.8),
    "2 bursts of 3 s": Case(build_bursts(2, 3.0), 0.15),
    "8 bursts of 3 s": Case(build_bursts(8, 3.0), 0.20),
    "8 bursts of 1 s": Case(build_bursts(8, 1.0), 0.20),
    "no ranges for 30 s": Case((Fault("range_gap", "cf1", "cf2"),), 0.16),
    "yaw rate bias, peer": Case((Fault("yaw_rate_bias", "cf2"),)),
    "yaw rate bias, own": Case((Fault("yaw_rate_bias", "cf1"),)),
    "height steps": Case(
        tuple(
            Fault("height_step", "cf2", duration_s=lasts, number=n)
            for lasts, n in ((1.0, 3), (2.0, 3), (3.0, 2))
        )
    ),
    "flow stuck for 10 s": Case((Fault("velocity_stuck", "cf1"),)),
    "flow silent for 5 s": Case((Fault("velocity_gap", "cf2"),)),
    "height silent for 10 s": Case((Fault("height_gap", "cf1", duration_s=10.0),)),
    "range offset 0.35 m": Case((Fault("range_offset", "cf1", "cf2"),)),
    "outliers, 25 %": Case((Fault("range_outliers", "cf1", "cf2"),)),
    "velocities 15 % high": Case((Fault("velocity_scale", "cf2"),)),
    "clock off by 50 ms": Case((Fault("clock_offset", "cf2"),)),
    "clock drift 100 ppm": Case((Fault("clock_drift", "cf2"),)),
    "landing": Case((Fault("landing", "cf2"),)),
    "crash": Case((Fault("crash", "cf2"),)),
    "burst, stuck, crash": Case(
        (
            *build_bursts(2, 3.0),
            Fault("velocity_stuck", "cf1", start_s=40.0, duration_s=5.0),
            Fault("crash", "cf2"),
        )
    ),
}
BAD = {"calibrated": (0.02, 0.10), "realistic": (0.04, 0.20), "harsh": (0.10, 0.50)}
"""Largest share of kept positions that may be bad: over all flights, and in the worst flight."""
