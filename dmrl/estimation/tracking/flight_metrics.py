"""Figures over the time of a flight: how long a peer is held, seen, missed and found again."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array

Mask = NDArray[np.bool_]

LOST_M, LOST_RAD, LOST_S = 3.0, 0.72, 3.0
"""A follower loses its leader when it is farther away, or farther off the camera's axis, for so
long."""
CONTACT_M = 0.2
"""Distance of a contact, metres."""
BANDS = {
    "distance_m": (0.0, 0.5, 1.0, 1.5, 2.0, math.inf),
    "turn_radps": (0.0, 0.25, 0.75, math.inf),
}
"""Edges of the bands by distance and by the observer's turn rate."""
LOOP_SHARES = (0.10, 0.53, 0.20, 0.06, 0.11)
"""Share of the images with the leader in view in each band of distance, in eight closed loops of
four networks over sketches, seeds 501 and 502."""
FATAL_S = 1.0
"""Length of a silence in which a closed loop can lose its leader, seconds: at 0.6 m/s and 0.7 m
the leader has left the middle half of the image by then."""

DEFINITIONS = {
    "held_s": "seconds until the peer is lost, or the whole flight; lost: over "
    f"{LOST_M:g} m away or over {LOST_RAD:g} rad off the camera's axis for {LOST_S:g} s, counted "
    "from its start",
    "held_to_end": "whether it is never lost",
    "contacts": f"stretches within {CONTACT_M:g} m",
    "least_m": "least distance",
    "in_view": "images with the peer in view",
    "recall": "share of these in which it is detected, within 16 px at the detector's threshold",
    "false_per_image": "other detections at the threshold, in an image",
    "silences, silence_s, longest_silence_s": "stretches of images with the peer in view and no "
    "detection of it: their number, mean and greatest length",
    "find_again_s": "mean time from its return into view to its next detection",
    "alarm_s, longest_alarm_s": "stretches of images with false detections: their mean and "
    "greatest length",
    "loop_s": "mean time in view between two events: an alarm, or a stretch of "
    f"{FATAL_S:g} s without a right detection at any confidence; images weighted by the "
    "distances of closed loops: ranks networks on one recording",
}
"""Definition of each figure, printed beside it."""


@dataclass(frozen=True, slots=True)
class PairFlight:
    """One observer and one peer over a flight.

    Parameters
    ----------
    robot, peer
        The two.
    true_s, true_m
        (N,) times and (N, 3) true positions of the peer in the observer's horizontal frame.
    image_s, distance_m, turn_radps
        (K,) times of the images, and distance and the observer's absolute turn rate there.
    in_view, detected, found
        (K,) whether the peer is in view, is detected at the threshold, and at the floor.
    false
        (K,) number of detections at the threshold that are of no peer.
    """

    robot: str
    peer: str
    true_s: Array
    true_m: Array
    image_s: Array
    distance_m: Array
    turn_radps: Array
    in_view: Mask
    detected: Mask
    found: Mask
    false: Array


def find_stretches(mask: Mask) -> NDArray[np.int64]:
    """Return (S, 2) first row and end of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return edges.reshape(-1, 2)


def compute_flight_figures(flight: PairFlight) -> dict[str, float | None]:
    """Compute the figures of ``DEFINITIONS``; None without data."""
    values = _figures_of_path(flight) | _figures_of_images(flight)
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _figures_of_path(flight: PairFlight) -> dict[str, float]:
    place = flight.true_m
    distance_m = np.linalg.norm(place, axis=1)
    off_axis = np.arctan2(np.hypot(place[:, 1], place[:, 2]), place[:, 0])
    away = find_stretches((distance_m > LOST_M) | (off_axis > LOST_RAD))
    time_s = flight.true_s
    lost = [a for a, b in away.tolist() if time_s[b - 1] - time_s[a] >= LOST_S]
    return {
        "held_s": float(time_s[lost[0] if lost else -1] - time_s[0]),
        "held_to_end": float(not lost),
        "contacts": float(len(find_stretches(distance_m < CONTACT_M))),
        "least_m": float(distance_m.min()),
    }


def _figures_of_images(flight: PairFlight) -> dict[str, float]:
    step_s = float(np.median(np.diff(flight.image_s))) if len(flight.image_s) > 1 else math.nan
    silences = np.diff(find_stretches(flight.in_view & ~flight.detected))[:, 0] * step_s
    alarms = np.diff(find_stretches(flight.false > 0))[:, 0] * step_s
    return {
        "in_view": float(flight.in_view.sum()),
        "recall": _mean(flight.detected[flight.in_view]),
        "false_per_image": _mean(flight.false),
        "silences": float(len(silences)),
        "silence_s": _mean(silences),
        "longest_silence_s": float(silences.max(initial=0.0)),
        "find_again_s": _mean(_times_to_find(flight, step_s)),
        "alarm_s": _mean(alarms),
        "longest_alarm_s": float(alarms.max(initial=0.0)),
        "loop_s": _compute_loop_time(flight, step_s),
    }


def _times_to_find(flight: PairFlight, step_s: float) -> Array:
    """Return the time to the first detection of every stretch in view but one from the start on.

    A stretch without a detection counts with its length.
    """
    out = []
    for first, end in find_stretches(flight.in_view).tolist():
        hits = np.flatnonzero(flight.detected[first:end])
        if first > 0:
            out.append((hits[0] if len(hits) else end - first) * step_s)
    return np.array(out, float)


def _compute_loop_time(flight: PairFlight, step_s: float) -> float:
    """Return the weighted time in view over the weighted number of fatal silences and alarms.

    Half an event is added: a recording without any then ranks by its length.
    """
    band = np.digitize(flight.distance_m, BANDS["distance_m"][1:-1])
    counts = np.bincount(band[flight.in_view], minlength=len(LOOP_SHARES))
    if not counts.any():
        return math.nan
    weight = np.where(counts > 0, LOOP_SHARES / np.maximum(counts, 1), 0.0)
    weight = weight[band] * counts.sum() / weight[band[flight.in_view]].sum()
    blind = find_stretches(flight.in_view & ~flight.found)
    fatal = [weight[a:b].mean() for a, b in blind.tolist() if (b - a) * step_s >= FATAL_S]
    fatal += [weight[a:b].mean() for a, b in find_stretches(flight.false > 0).tolist()]
    return float(counts.sum() * step_s / (sum(fatal) + 0.5))


def compute_bands(flight: PairFlight) -> list[Mapping[str, float | str | None]]:
    """Return images in view, recall and false detections by distance and by turn rate."""
    rows: list[Mapping[str, float | str | None]] = []
    for by, edges in BANDS.items():
        values = getattr(flight, by)
        for low, high in pairwise(edges):
            inside = (values >= low) & (values < high)
            recall = _mean(flight.detected[inside & flight.in_view])
            false = _mean(flight.false[inside])
            rows.append(
                {
                    "by": by,
                    "from": low,
                    "to": high if math.isfinite(high) else None,
                    "in_view": float((inside & flight.in_view).sum()),
                    "recall": recall if math.isfinite(recall) else None,
                    "false_per_image": false if math.isfinite(false) else None,
                }
            )
    return rows


def _mean(values: NDArray[np.generic]) -> float:
    return float(np.mean(values.astype(float))) if len(values) else math.nan
