"""Compare tracks with the ground truth, beside detections of single images."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from dmrl.estimation.model.position_metrics import ErrorTrace
from dmrl.geometry.frames import Array

MAX_MATCH_M = 1.0
"""Largest distance between a track and its peer, metres. Tracks farther from every peer are false.
No record of how the value was chosen."""
CHI2_95_OF_3 = 7.815
"""95 % point of chi-square with three degrees of freedom."""

DEFINITIONS = {
    "in_view": "true positions of peers inside the image, one for each peer and image",
    "rmse_m": "root of the mean squared 3D error of the tracks; N peers in view are matched one "
    "to one to tracks, least total distance",
    "single_rmse_m": "the same of detections, each put into 3D by its own image alone: the N most "
    "confident of the image, matched in the same way; over the peers that also have a track",
    "reduction": "by how much less the tracks' is, over that of the detections",
    "median_m, single_median_m": "medians of those errors",
    "coverage_95": "share of those peers inside their track's 95 % ellipsoid",
    "nees": "mean of the squared error over its covariance; 3 if that is right",
    "followed, detected": "share of the peers in view with a track, a detection within "
    f"{MAX_MATCH_M:g} m",
    "false_tracks_per_min": f"tracks more than {MAX_MATCH_M:g} m from every peer, in view or not, "
    "for more than half of their life, a minute",
    "named_right": "share of the named tracks of peers in view that have the right name",
}
"""Definition of each figure, printed beside it."""


@dataclass(frozen=True, slots=True)
class EvaluatedTracks:
    """Tracks of one observer beside the truth, one row for each peer in view of an image.

    Parameters
    ----------
    robot
        The observer.
    time_s
        (N,) seconds from the first image.
    peer, named
        (N,) the peer, and the name of its track; empty without a name.
    error_m, single_error_m
        (N, 3) errors of the track and of the detection matched to it; NaN without one.
    covariance
        (N, 3, 3) of the track, m^2.
    false_tracks
        Number of tracks without a peer.
    length_s
        Seconds between the first and the last image.
    """

    robot: str
    time_s: Array
    peer: list[str]
    named: list[str]
    error_m: Array
    single_error_m: Array
    covariance: Array
    false_tracks: int
    length_s: float

    @property
    def trace(self) -> ErrorTrace:
        """Errors over time, those of tracks and of single images apart."""
        errors = {"single images": self.single_error_m, "tracks": self.error_m}
        sigma_m = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        title, name = f"{self.robot}: tracks minus truth", f"track-error-{self.robot}"
        return ErrorTrace(title, name, self.time_s, sigma_m, errors)


def match_positions(
    truth_m: Array, found_m: Array, radius_m: float = math.inf
) -> NDArray[np.int64]:
    """Match true and estimated positions; return (J,) indices of the estimates, -1 for none.

    Pairs within ``MAX_MATCH_M`` come first: a distance beyond it adds next to nothing, so that one
    false position does not take a good one from its peer.

    Parameters
    ----------
    truth_m, found_m
        (J, 3) and (D, 3) positions, metres. NaN: unknown, never matched.
    radius_m
        Largest distance of a match.
    """
    out = np.full(len(truth_m), -1, np.int64)
    distance_m = np.linalg.norm(truth_m[:, None] - found_m, axis=-1)
    near = distance_m <= radius_m
    cost = np.where(distance_m <= MAX_MATCH_M, distance_m, MAX_MATCH_M + 1e-3 * distance_m)
    rows, columns = linear_sum_assignment(np.where(near, cost, 1e6))
    near = near[rows, columns]
    out[rows[near]] = columns[near]
    return out


def compute_figures(tracks: EvaluatedTracks, settle_s: float) -> dict[str, float | None]:
    """Compute the figures of ``DEFINITIONS``; None without data.

    Parameters
    ----------
    judged
        Tracks beside the truth.
    settle_s
        Settling time. Earlier images count for false tracks only.
    """
    late = tracks.time_s >= settle_s
    error_m, single_m = tracks.error_m[late], tracks.single_error_m[late]
    size_m, single_size_m = (np.linalg.norm(e, axis=1) for e in (error_m, single_m))
    both = np.isfinite(size_m) & np.isfinite(single_size_m)
    tracked = np.isfinite(size_m)
    inverse = np.linalg.inv(tracks.covariance[late][tracked])
    squared = np.einsum("ni,nij,nj->n", error_m[tracked], inverse, error_m[tracked])
    rmse_m, single_rmse_m = _root_mean_square(size_m[both]), _root_mean_square(single_size_m[both])
    names = zip(tracks.named, tracks.peer, late, strict=True)
    values = {
        "in_view": float(late.sum()),
        "rmse_m": rmse_m,
        "single_rmse_m": single_rmse_m,
        "reduction": 1 - rmse_m / single_rmse_m if single_rmse_m else math.nan,
        "median_m": _median_or_nan(size_m[both]),
        "single_median_m": _median_or_nan(single_size_m[both]),
        "coverage_95": _mean_or_nan(squared <= CHI2_95_OF_3),
        "nees": _mean_or_nan(squared),
        "followed": _mean_or_nan(size_m <= MAX_MATCH_M),
        "detected": _mean_or_nan(single_size_m <= MAX_MATCH_M),
        "false_tracks_per_min": tracks.false_tracks / (tracks.length_s / 60 or math.nan),
        "named_right": _mean_or_nan(
            np.array([name == peer for name, peer, ok in names if name and ok])
        ),
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _median_or_nan(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _mean_or_nan(values: NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else math.nan
