"""One colour per source of positions, the same in every picture."""

# After Okabe and Ito, told apart by colour-blind eyes, but as bright as text on grey must be.
RGB = {
    "truth": (60, 235, 160),
    "estimate": (110, 200, 255),
    "published": (250, 240, 90),
    "hand": (255, 165, 215),
    "detection": (255, 150, 60),
    "other": (200, 200, 200),
}
