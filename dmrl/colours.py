"""One colour per meaning, the same in every picture, plot and view."""

# After Okabe and Ito, told apart by colour-blind eyes, but as bright as text on grey must be.
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
"""Sources of positions, and what was measured."""

SECOND_DETECTION = (170, 230, 60)
"""A second model's detections, beside those of a first."""

OWN, PEER = (240, 240, 240), (150, 150, 150)
"""A robot's own sensors, and its peer's."""

STATUS_RGB = {
    "OK": (70, 120, 175),
    "UNCONVERGED": (130, 130, 130),
    "AMBIGUOUS": (200, 60, 60),
}
"""Values of ``dmrl.v1.Status``, by name."""
