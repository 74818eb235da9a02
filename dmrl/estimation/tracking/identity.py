"""Assign robot names to tracks by the ranges that keep fitting their distance."""

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.optimize import linear_sum_assignment

from dmrl.estimation.tracking.tracker import Track

RANGE_STD_M = 0.2
"""Standard deviation of a UWB range, its bias included, metres. No record of how the value was
chosen."""
AVERAGING_S = 2.0
"""Time constant of the average misfit, seconds. No record of how the value was chosen."""
MAX_MISFIT = 9.0
"""Largest misfit of a range, in variances. It bounds the effect of a detour. Three standard
deviations; no other record of how the value was chosen."""
MAX_MEAN_MISFIT, MIN_MISFIT_MARGIN = 4.0, 1.5
"""Largest mean misfit of an accepted name; and margin by which every other name must fit worse. No
record of how the values were chosen."""


class TrackIdentity:
    """Names of one observer's tracks, from the ranges to its peers."""

    def __init__(self) -> None:
        self._misfit: dict[tuple[int, str], float] = {}

    def assign(
        self, tracks: Iterable[Track], range_m: Mapping[str, float], dt_s: float
    ) -> dict[int, str]:
        """Assign names to the tracks whose robot is unambiguous; return them by track number.

        Parameters
        ----------
        tracks
            All confirmed tracks.
        range_m
            Measured distance by peer. Peers without a range are missing.
        dt_s
            Seconds since the last call.
        """
        tracks = list(tracks)
        fresh = 1 - np.exp(-dt_s / AVERAGING_S)
        for track in tracks:
            for peer, measured_m in range_m.items():
                key = track.number, peer
                before = self._misfit.get(key)
                now = _range_misfit(track, measured_m)
                self._misfit[key] = now if before is None else before + fresh * (now - before)
        alive = {track.number for track in tracks}
        self._misfit = {key: value for key, value in self._misfit.items() if key[0] in alive}
        return self._assign_names(tracks)

    def _assign_names(self, tracks: list[Track]) -> dict[int, str]:
        """Assign names one to one by the total misfit, and keep the unambiguous ones."""
        peers = sorted({peer for _, peer in self._misfit})
        cost = np.full((len(tracks), len(peers)), MAX_MISFIT)
        for k, track in enumerate(tracks):
            for j, peer in enumerate(peers):
                cost[k, j] = self._misfit.get((track.number, peer), MAX_MISFIT)
        out = {}
        for k, j in zip(*linear_sum_assignment(cost), strict=True):
            others = np.delete(cost[k], j)
            if cost[k, j] < MAX_MEAN_MISFIT and (others > cost[k, j] + MIN_MISFIT_MARGIN).all():
                out[tracks[k].number] = peers[j]
        return out


def _range_misfit(track: Track, measured_m: float) -> float:
    """Return the squared difference of a range and the track's distance, over its variance."""
    distance_m = max(float(np.linalg.norm(track.position_m)), 1e-3)
    along = track.position_m / distance_m
    variance = RANGE_STD_M**2 + float(along @ track.covariance @ along)
    return min((measured_m - distance_m) ** 2 / variance, MAX_MISFIT)
