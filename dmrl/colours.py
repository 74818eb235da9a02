"""Colours by meaning, the same in every image, plot and view."""

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

SECOND_DETECTION_RGB = (80, 140, 255)
"""Colour of a second model's detections, beside those of a first."""

OWN_RGB, PEER_RGB = (240, 240, 240), (150, 150, 150)
"""Colours of a robot's own sensors, and of its peer's."""

STATUS_RGB = {"OK": (70, 120, 175), "UNCONVERGED": (130, 130, 130), "AMBIGUOUS": (200, 60, 60)}
"""Colours of the values of ``dmrl.v1.Status``, by name."""
