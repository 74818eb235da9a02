"""Colours by meaning, the same in every image, plot and view."""

import numpy as np
from numpy.typing import NDArray

# After Okabe and Ito, distinguishable with colour blindness, but bright enough for text on grey.
RGB = {
    "truth": (60, 235, 160),
    "estimate": (110, 200, 255),
    "published": (250, 240, 90),
    "hand": (255, 165, 215),
    "detection": (255, 150, 60),
    "track": (255, 95, 95),
    "range": (185, 150, 255),
    "other": (200, 200, 200),
}
"""Colours of the sources of positions, and of other measurements."""

SECOND_DETECTION_RGB = (255, 125, 245)
"""Colour of a second model's detections, beside those of a first."""

OWN_RGB, PEER_RGB = (240, 240, 240), (150, 150, 150)
"""Colours of a robot's own sensors, and of its peer's."""

STATUS_RGB = {"OK": (70, 120, 175), "UNCONVERGED": (130, 130, 130), "AMBIGUOUS": (200, 60, 60)}
"""Colours of the values of ``dmrl.v1.Status``, by name."""

MIN_DEPTH_CONFIDENCE = 0.05
"""Confidence below which a cell of a map is drawn without a depth: it belongs to no robot."""

VIRIDIS_RGB = np.array(
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], float
)


def paint_viridis(shares: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the colours, (..., 3), of values of 0 to 1; values outside get the nearest colour."""
    place = np.asarray(shares, float) * (len(VIRIDIS_RGB) - 1)
    stops = np.arange(len(VIRIDIS_RGB))
    rgb = [np.interp(place, stops, channel) for channel in VIRIDIS_RGB.T]
    return np.stack(rgb, axis=-1).astype(np.uint8)
