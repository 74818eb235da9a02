"""Score how likely a label of an image is wrong or missing, from a model's detections.

Most labels are right. So all images together tell how far detections lie from labels, how often a
label has none, and how often a detection of some confidence and depth is near no label. With these,
each label is compared under two hypotheses: its robot is in its place, or anywhere else.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.inference.detector_rates import fit_logistic

Array = NDArray[np.float64]
Fields = Mapping[str, Any]

NEAR_PX = 8.0
"""A detection within this distance supports a label, pixels; or within 3 sigma of the label."""
NEAR_AT_1_M_PX = 3.0
"""The same for a robot at 1 m, in inverse proportion to depth: a third of the half-width that a
Crazyflie has in the AI-deck's camera. The centre of a large robot is less certain in pixels."""
MOVED_SHARE, EMPTY_SHARE, LACKING_SHARE = 0.05, 0.001, 0.001
"""Shares of labels beside their robot, of labels whose robot is not in view, and of images that
lack a label, before a look at the detections."""
FREEDOM = 3.0
"""Degrees of freedom of Student's t for the pixels between a label and its detection."""
DEPTH_RANGE, DEPTH_OUTLIERS = float(np.log(10)), 0.05
"""Range of log depth, and share of a robot's detections that have any depth in it."""
GUESSED_LOGITS, GUESSED_FOUND = np.arange(-4.0, 5.0), 0.75
"""Before a look at the labels: the confidences of these logits are probabilities, and this share
of the robots is found. Each counts like one detection or label."""
GUESSED_ERROR, GUESSED_DEPTH_ERROR = 0.3, 0.2
"""Median errors if no detection supports a label, in units of the distance that supports, and of
log depth. A tenth of them is the least."""


class _Image(NamedTuple):
    """An image with L labels inside it and D detections; distances and gaps are (L, D)."""

    label_facts: Array
    found_facts: Array
    near_px: Array
    distance_px: Array
    depth_gap: Array
    supports: NDArray[np.bool_]


class _Rates(NamedTuple):
    """What labels and their detections have in common."""

    is_robot: Array
    is_found: Array
    error: float
    depth_bias: float
    depth_error: float
    robots: float


def score_suspicion(
    images: Sequence[tuple[Sequence[Fields], Sequence[Fields]]], size_px: tuple[float, float]
) -> Array:
    """Return for each image the probability that a label is wrong or missing, 0 to 1.

    Parameters
    ----------
    images
        Labels and detections of each: fields of PeerLabel and of Detection, of any confidence.
        Labels outside the image are ignored.
    size_px
        Width and height of the images.
    """
    compared = [_compare(labels, found, size_px) for labels, found in images]
    rates = _fit([image for image in compared if len(image.near_px)])
    return np.array([_score_image(image, rates, size_px) for image in compared])


def _compare(
    labels: Sequence[Fields], found: Sequence[Fields], size_px: tuple[float, float]
) -> _Image:
    """Return the facts of labels and detections of an image, and the distances between them."""
    place, seen = _columns(labels, "u_px", "v_px"), _columns(found, "u_px", "v_px")
    inside = ((place >= 0) & (place < size_px)).all(axis=1)
    depth, seen_depth = _log_depths(labels)[inside], _log_depths(found)
    sigma_px = _columns(labels, "sigma_u_px", "sigma_v_px")[inside].max(axis=1)
    large_px = NEAR_AT_1_M_PX * np.exp(-np.nan_to_num(depth))
    near_px = np.fmax(np.fmax(NEAR_PX, 3 * sigma_px), large_px)
    distance_px = np.linalg.norm(place[inside][:, None] - seen[None], axis=2)
    said = np.clip(_columns(found, "confidence")[:, 0], 1e-4, 1 - 1e-4)
    facts = np.log(said / (1 - said)), np.nan_to_num(seen_depth)
    return _Image(
        np.column_stack([np.ones(len(depth)), np.nan_to_num(depth)]),
        np.column_stack([np.ones(len(said)), *facts]),
        near_px,
        distance_px,
        seen_depth[None] - depth[:, None],
        distance_px <= near_px[:, None],
    )


def _columns(rows: Sequence[Fields], *names: str) -> Array:
    """Return fields as (N, names) values; a missing one is 0."""
    values = [one.get(name, 0.0) for one in rows for name in names]
    return np.array(values, np.float64).reshape(len(rows), len(names))


def _log_depths(rows: Sequence[Fields]) -> Array:
    """Return (N,) logarithms of the depths; NaN if unknown."""
    depth_m = _columns(rows, "depth_m")[:, 0]
    return np.log(np.where((depth_m > 0) & (depth_m < np.inf), depth_m, np.nan))


def _fit(images: Sequence[_Image]) -> _Rates:
    """Fit the rates to images that have labels; start from guesses."""
    guess = np.column_stack([0 * GUESSED_LOGITS + 1, GUESSED_LOGITS, 0 * GUESSED_LOGITS])
    is_robot = [1 / (1 + np.exp(-GUESSED_LOGITS)), *(i.supports.any(axis=0) for i in images)]
    is_found = [[GUESSED_FOUND], *(i.supports.any(axis=1) for i in images)]
    error = [(i.distance_px / i.near_px[:, None])[i.supports] for i in images]
    gap = np.concatenate([np.zeros(0), *(i.depth_gap[i.supports] for i in images)])
    bias = _median(gap, 0.0)
    return _Rates(
        fit_logistic(
            np.concatenate([guess, *(i.found_facts for i in images)]), np.concatenate(is_robot)
        ),
        fit_logistic(
            np.concatenate([[[1.0, 0.0]], *(i.label_facts for i in images)]),
            np.concatenate(is_found),
        ),
        max(_median(np.concatenate([np.zeros(0), *error]), GUESSED_ERROR), GUESSED_ERROR / 10),
        bias,
        max(_median(np.abs(gap - bias), GUESSED_DEPTH_ERROR), GUESSED_DEPTH_ERROR / 10),
        max(sum(len(i.near_px) for i in images), 1) / max(len(images), 1),
    )


def _median(values: Array, otherwise: float) -> float:
    """Return the median of the values that are known, or ``otherwise``."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else otherwise


def _score_image(image: _Image, rates: _Rates, size_px: tuple[float, float]) -> float:
    """Return the probability that a label is wrong or missing."""
    # How much likelier a detection is if a robot is somewhere in the image than if none is.
    likelier = np.exp(np.clip(image.found_facts @ rates.is_robot, -50, 50)) / rates.robots
    loose = ~image.supports.any(axis=0)
    seen = likelier * _compare_depths(image.depth_gap, rates) * size_px[0] * size_px[1]
    missed = 1 / (1 + np.exp(np.clip(image.label_facts @ rates.is_found, -50, 50)))
    scale_px = (rates.error * image.near_px)[:, None]
    here = (1 + (image.distance_px / scale_px) ** 2 / FREEDOM) ** (-FREEDOM / 2 - 1) / scale_px**2
    # If a label is wrong, every distance up to the image's diagonal is as likely.
    away_px = np.maximum(image.distance_px, image.near_px[:, None])
    there = loose / (away_px * np.hypot(*size_px))
    right, moved = (missed + (seen * place).sum(axis=1) / (2 * np.pi) for place in (here, there))
    wrong = (MOVED_SHARE * moved + EMPTY_SHARE) / right
    odds = np.append(wrong, LACKING_SHARE * likelier[loose].sum())
    return float(1 - np.prod(1 / (1 + odds)))


def _compare_depths(gap: Array, rates: _Rates) -> Array:
    """Return how much likelier the depths are if a detection is the robot of a label."""
    scale = rates.depth_error / np.log(2)  # Laplace: half of the errors are below the median
    alike = DEPTH_RANGE / (2 * scale) * np.exp(-np.abs(gap - rates.depth_bias) / scale)
    alike = (1 - DEPTH_OUTLIERS) * alike + DEPTH_OUTLIERS
    return np.where(np.isnan(gap), 1.0, alike)
