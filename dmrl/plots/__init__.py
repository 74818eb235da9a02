"""Figures of evaluations and reports, as PNG and SVG. The only user of matplotlib."""

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

__all__ = ["Example", "GalleryImage", "MapPair", "Side", "plot_error_by_distance"]
__all__ += ["plot_error_trace", "plot_error_violins", "plot_examples", "plot_gallery"]
__all__ += ["plot_map_pairs", "plot_model_sides"]
