"""Format the metrics of detections: a table with a column per range of depth, and JSON values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from dmrl.learn.inference.detection_metrics import (
    BandMetrics,
    ScoredDetections,
    compute_curves,
)

# Name of a figure, its words in the table, and its format.
FIGURE_ROWS = (
    ("median_px", "median error, px", ".2f"),
    ("mean_px", "mean error, px", ".1f"),
    ("rmse_px", "RMS error, px", ".1f"),
    ("p95_px", "95th percentile, px", ".1f"),
    ("within_8_px", "within 8 px", ".1%"),
    ("within_20_px", "within 20 px", ".1%"),
    ("bias_u_px", "median error in u, px", ".2f"),
    ("bias_v_px", "median error in v, px", ".2f"),
    ("depth_mae_m", "depth MAE, m", ".3f"),
    ("depth_rmse_m", "depth RMSE, m", ".3f"),
    ("r2_u", "R2 of u", ".2f"),
    ("r2_v", "R2 of v", ".2f"),
    ("r2_depth", "R2 of depth", ".2f"),
    ("precision", "precision", ".1%"),
    ("recall", "recall", ".1%"),
    ("f1", "F1", ".3f"),
    ("ap_8_px", "AP at 8 px", ".3f"),
    ("ap_16_px", "AP at 16 px", ".3f"),
)


def build_band_table(
    bands: Sequence[Mapping[str, Any]],
) -> tuple[list[str], list[list[object]]]:
    """Build headers and rows: all labels, then each band of depth that has labels.

    Parameters
    ----------
    bands
        Metrics by band as JSON values, all distances first; see `band_to_json`.
    """
    overall, *others = bands
    shown = [overall, *(band for band in others if band.get("labels", 1))]
    rows: list[list[object]] = [["labels", *(str(band.get("labels", "-")) for band in shown)]]
    for name, words, form in FIGURE_ROWS:
        if name in overall:
            rows.append([words, *(format_interval(band[name], form) for band in shown)])
    return ["all", *(_format_range(band["from_m"], band["to_m"]) for band in shown[1:])], rows


def _format_range(from_m: float, to_m: float | None) -> str:
    return f"{from_m:g}{' m and more' if to_m is None else f' to {to_m:g} m'}"


def format_interval(figure: Mapping[str, Any], form: str) -> str:
    """Format a metric with its interval in brackets; a dash if there is nothing to measure."""
    ends = [figure["low"], figure["high"]]
    if figure["value"] is None:
        return "-"
    within = ", ".join(format(end, form).removesuffix("%") for end in ends if end is not None)
    return f"{format(figure['value'], form)} [{within}]"


def band_to_json(band: BandMetrics) -> dict[str, Any]:
    """Return the metrics of one range of depth as JSON values."""
    return {
        "from_m": band.from_m,
        "to_m": finite_or_none(band.to_m),
        "labels": band.labels,
        "images": band.images,
        "unmatched_labels": band.unmatched,
        **{
            name: {key: finite_or_none(value) for key, value in asdict(figure).items()}
            for name, figure in band.figures.items()
        },
    }


def curves_to_json(scored: ScoredDetections) -> dict[str, list[float | None]]:
    """Return precision, recall and other curves over the confidence as JSON values."""
    found = asdict(compute_curves(scored))
    return {
        name: [finite_or_none(value) for value in values.tolist()] for name, values in found.items()
    }


def finite_or_none(value: float) -> float | None:
    """Return a number if it is finite, else None: JSON has neither NaN nor infinity."""
    return value if math.isfinite(value) else None
