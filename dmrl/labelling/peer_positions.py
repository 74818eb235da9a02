"""Positions of a peer over time, in the observer's horizontal frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array, Pair
from dmrl.estimation.solver.estimate import Estimate

POSITION_HZ = 20.0
"""Rate of the written positions; images have positions of their own."""
POSITION_DECIMALS, COVARIANCE_DECIMALS = 6, 7
"""Micrometres, and squares of 0.3 mm. Processors differ in the digits that are rounded off. With
two digits more, one covariance in a flight of 12 s differed."""


@dataclass(frozen=True, slots=True)
class PeerPositions:
    """Positions of one peer at N times, in the observer's horizontal frame.

    Parameters
    ----------
    time_ns
        (N,) log times.
    xyz_m
        (N, 3).
    covariance
        (N, 3, 3) m^2.
    status
        (N,) as in ``dmrl.v1.Status``.
    """

    time_ns: NDArray[np.int64]
    xyz_m: Array
    covariance: Array
    status: NDArray[np.int8]


def sample_positions(
    start_ns: int, pair: Pair, estimate: Estimate, images_ns: NDArray[np.int64]
) -> PeerPositions:
    """Return the positions of an estimate at 20 Hz and at the images within the flight.

    Parameters
    ----------
    start_ns
        Log time of second zero.
    pair
        The observer and its peer, with their heights.
    estimate
        Horizontal positions of the peer.
    images_ns
        (K,) when the observer's images were taken.
    """
    period_ns = round(1e9 / POSITION_HZ)
    first, last = (start_ns + round(float(t) * 1e9) for t in estimate.time_s[[0, -1]])
    regular = np.arange(-(-first // period_ns), last // period_ns + 1) * period_ns
    time_ns = np.union1d(regular, images_ns[(images_ns >= first) & (images_ns <= last)])
    time_s = (time_ns - start_ns) * 1e-9
    xy, spread, status = estimate.interpolate_at(np.asarray(time_s, float))
    z = np.interp(time_s, pair.time_s, pair.peer.height_m - pair.own.height_m)
    if estimate.height_m is not None:
        z = z - np.interp(time_s, estimate.time_s, estimate.height_m)
    covariance = np.zeros((len(time_ns), 3, 3))
    covariance[:, :2, :2] = spread
    std = estimate.noise.height_std_m if estimate.height_std_m is None else estimate.height_std_m
    covariance[:, 2, 2] = np.interp(time_s, estimate.time_s, std + 0 * estimate.time_s) ** 2
    # The last bits depend on the processor.
    xyz_m = np.column_stack([xy, z]).round(POSITION_DECIMALS)
    return PeerPositions(time_ns, xyz_m, covariance.round(COVARIANCE_DECIMALS), status)
