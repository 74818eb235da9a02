"""Titles, formats and definitions of the metrics of detections, for tables and JSON files."""

import tomllib
from importlib.resources import files

_TABLE = tomllib.loads(files(__package__).joinpath("metrics.toml").read_text("utf-8"))
METRICS: dict[str, dict[str, str]] = _TABLE["metrics"]
"""Title, format and definition of each metric."""
METRIC_DEFINITIONS: dict[str, str] = _TABLE["rules"] | {
    name: metric["definition"] for name, metric in METRICS.items()
}
"""Definitions of the metrics and of the rules behind them, in words."""
