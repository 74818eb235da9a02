"""Score how likely a label of an image is wrong or missing, from a model's detections."""

from collections.abc import Mapping, Sequence
from math import hypot
from typing import Any

NEAR_PX = 8.0
"""A detection within this distance supports a label, pixels; or within 3 sigma of the label."""
MISSING_SHARE = 0.5
"""Score of a confident detection without a label, if every label of the image is supported."""


def score_suspicion(
    labels: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]]
) -> float:
    """Return the suspicion that a label of an image is wrong or missing, 0 to 1.

    A wrong label leaves two traces: a detection that no label explains, and a label that no
    detection supports. Each alone may be an error of the model, so their product counts most.

    Parameters
    ----------
    labels
        Fields of PeerLabel.
    found
        Fields of Detection, of any confidence.
    """
    unexplained = max(
        (one["confidence"] for one in found if not any(_is_near(label, one) for label in labels)),
        default=0.0,
    )
    unsupported = max(
        (
            1.0 - max((one["confidence"] for one in found if _is_near(label, one)), default=0.0)
            for label in labels
        ),
        default=0.0,
    )
    both = unexplained * unsupported
    alone = max(MISSING_SHARE * unexplained, (1 - MISSING_SHARE) * unsupported * 0.2)
    return float(max(both, alone))


def _is_near(label: Mapping[str, Any], one: Mapping[str, Any]) -> bool:
    sigma = max(label["sigma_u_px"], label["sigma_v_px"])
    apart = hypot(label["u_px"] - one["u_px"], label["v_px"] - one["v_px"])
    return bool(apart <= max(NEAR_PX, 3 * sigma))
