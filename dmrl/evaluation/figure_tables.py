"""Format the metrics of detections: a table with a column per range of depth, and JSON values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dmrl.learn.inference.detection_metrics import BandMetrics, ScoredDetections, compute_curves
from dmrl.learn.inference.metric_definitions import METRICS
from dmrl.recording import build_input

Columns = Sequence[tuple[str, str, str]]
"""Key of a value, its title in a table, and its format: see `format_value`."""


def metric_columns(*names: str) -> Columns:
    """Return the columns of metrics of detections; all without names."""
    return [(name, METRICS[name]["title"], METRICS[name]["format"]) for name in names or METRICS]


def format_values(values: Mapping[str, Any], columns: Columns) -> list[str]:
    """Format the values of a row of a table; a dash for None."""
    found = [(values.get(key), form) for key, _, form in columns]
    return ["-" if value is None else format_value(value, form) for value, form in found]


def format_value(value: float, form: str) -> str:
    """Format a value; ``.2f from -1`` names the smallest that says anything: others are "< -1"."""
    form, _, least = form.partition(" from ")
    return f"< {least}" if least and value < float(least) else format(value, form)


def describe_source(recording: Path) -> dict[str, str]:
    """Return the name and the hash of a recording as JSON values."""
    source = build_input(recording)
    return {"name": source.name, "sha256": source.sha256}


def build_band_table(bands: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[object]]]:
    """Build headers and rows: all labels, then each band of depth that has labels.

    Parameters
    ----------
    bands
        Metrics by band as JSON values, all distances first; see `band_to_json`.
    """
    overall, *others = bands
    shown = [overall, *(band for band in others if band.get("labels", 1))]
    rows: list[list[object]] = [["labels", *(str(band.get("labels", "-")) for band in shown)]]
    for name, title, form in metric_columns():
        if name in overall:
            rows.append([title, *(format_interval(band[name], form) for band in shown)])
    return ["all", *(_format_range(band["from_m"], band["to_m"]) for band in shown[1:])], rows


def _format_range(from_m: float, to_m: float | None) -> str:
    return f"{from_m:g}{' m and more' if to_m is None else f' to {to_m:g} m'}"


def format_interval(figure: Mapping[str, Any], form: str) -> str:
    """Format a metric with its interval in brackets; a dash if there is nothing to measure."""
    ends = [figure["low"], figure["high"]]
    if figure["value"] is None:
        return "-"
    within = ", ".join(format_value(end, form).removesuffix("%") for end in ends if end is not None)
    value = format_value(figure["value"], form)
    return value if not within or value.startswith("<") else f"{value} [{within}]"


def band_to_json(band: BandMetrics) -> dict[str, Any]:
    """Return the metrics of one range of depth as JSON values."""
    return {
        "from_m": band.from_m,
        "to_m": band.to_m if math.isfinite(band.to_m) else None,
        "labels": band.labels,
        "images": band.images,
        "unmatched_labels": band.unmatched,
        **{name: finite_values(asdict(figure)) for name, figure in band.figures.items()},
    }


def curves_to_json(scored: ScoredDetections) -> dict[str, list[float | None]]:
    """Return precision, recall and other curves over the confidence as JSON values."""
    return {
        name: list(finite_values(dict(enumerate(values.tolist()))).values())
        for name, values in asdict(compute_curves(scored)).items()
    }


def finite_values(values: Mapping[Any, float]) -> dict[Any, float | None]:
    """Return numbers that are finite, else None: JSON has neither NaN nor infinity."""
    return {name: value if math.isfinite(value) else None for name, value in values.items()}
