"""Figures of datasets and evaluations, as PNG and SVG. The only user of matplotlib."""

from dmrl.plots.datasets import depth_histogram, peers_per_image, position_heat
from dmrl.plots.error_plots import error_by_distance, error_trace, error_violins
from dmrl.plots.image_figures import Circled, Example, MapPair, examples, gallery, map_pairs
from dmrl.plots.robot_figures import Side, model_sides
from dmrl.plots.style import save

__all__ = [
    "Circled",
    "Example",
    "MapPair",
    "Side",
    "depth_histogram",
    "error_by_distance",
    "error_trace",
    "error_violins",
    "examples",
    "gallery",
    "map_pairs",
    "model_sides",
    "peers_per_image",
    "position_heat",
    "save",
]
