"""Score how likely a label of an image is wrong or missing, from a model's detections."""

from collections.abc import Mapping, Sequence
from math import exp, hypot, inf, log
from typing import Any

NEAR_PX = 8.0
"""A detection within this distance supports a label, pixels; or within 3 sigma of the label."""
NEAR_AT_1_M_PX = 3.0
"""The same for a robot at 1 m, in inverse proportion to depth: a third of the half-width that a
Crazyflie has in the AI-deck's camera. The centre of a large robot is less certain in pixels."""
SCATTER_PX, DEPTH_SCATTER = 80.0, 0.5
"""Scales on which a moved label is less likely to be the robot of a detection: distance in pixels,
and difference of log depth."""
MISSING_SHARE, UNSUPPORTED_SHARE = 0.1, 0.02
"""Scores of a sure detection without a label, and of a label without a detection, each alone."""


def score_suspicion(
    labels: Sequence[Mapping[str, Any]],
    found: Sequence[Mapping[str, Any]],
    size_px: tuple[float, float] = (inf, inf),
) -> float:
    """Return the suspicion that a label of an image is wrong or missing, 0 to 1.

    A wrong label leaves two traces: a detection that no label explains, and a label that no
    detection supports. Each alone may be an error of the model. Both together count most, if they
    are close to each other and of similar depth.

    Parameters
    ----------
    labels
        Fields of PeerLabel. Those outside the image are ignored.
    found
        Fields of Detection, of any confidence.
    size_px
        Width and height of the image.
    """
    loose = [one for one in found if not any(_is_near(label, one) for label in labels)]
    best = MISSING_SHARE * max((one["confidence"] for one in loose), default=0.0)
    for label in labels:
        if not (0 <= label["u_px"] < size_px[0] and 0 <= label["v_px"] < size_px[1]):
            continue
        support = max((one["confidence"] for one in found if _is_near(label, one)), default=0.0)
        moved = max((one["confidence"] * _affinity(label, one) for one in loose), default=0.0)
        best = max(best, (1 - support) * max(moved, UNSUPPORTED_SHARE))
    return float(best)


def _affinity(label: Mapping[str, Any], one: Mapping[str, Any]) -> float:
    """Return how likely a detection is the robot of a label that was moved, 0 to 1."""
    likely = exp(-_distance_px(label, one) / SCATTER_PX)
    depths = label.get("depth_m", 0.0), one.get("depth_m", 0.0)
    if min(depths) <= 0:
        return likely
    return likely * exp(-abs(log(depths[0] / depths[1])) / DEPTH_SCATTER)


def _distance_px(label: Mapping[str, Any], one: Mapping[str, Any]) -> float:
    return hypot(label["u_px"] - one["u_px"], label["v_px"] - one["v_px"])


def _is_near(label: Mapping[str, Any], one: Mapping[str, Any]) -> bool:
    sigma = max(label["sigma_u_px"], label["sigma_v_px"])
    depth_m = label.get("depth_m", 0.0)
    large_px = NEAR_AT_1_M_PX / depth_m if depth_m > 0 else 0.0
    return bool(_distance_px(label, one) <= max(NEAR_PX, 3 * sigma, large_px))
