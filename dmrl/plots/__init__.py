"""Figures of datasets and evaluations, as PNG and SVG. The only user of matplotlib."""

from dmrl.plots.datasets import plot_depth_histogram, plot_peers_per_image, plot_position_heat
from dmrl.plots.error_plots import plot_error_by_distance, plot_error_trace, plot_error_violins
from dmrl.plots.image_figures import (
    Example,
    GalleryImage,
    MapPair,
    plot_examples,
    plot_gallery,
    plot_map_pairs,
)
from dmrl.plots.robot_figures import Side, plot_model_sides
from dmrl.plots.style import save_figure

__all__ = [
    "Example",
    "GalleryImage",
    "MapPair",
    "Side",
    "plot_depth_histogram",
    "plot_error_by_distance",
    "plot_error_trace",
    "plot_error_violins",
    "plot_examples",
    "plot_gallery",
    "plot_map_pairs",
    "plot_model_sides",
    "plot_peers_per_image",
    "plot_position_heat",
    "save_figure",
]
