"""Formats of metrics in tables."""

from dmrl.evaluation.figure_tables import format_interval, format_values, metric_columns


def test_an_r2_far_below_zero_has_a_floor_in_tables() -> None:
    columns = metric_columns("r2_depth", "median_px")
    assert format_values({"r2_depth": -816.8, "median_px": 2.0}, columns) == ["< -1", "2.00"]
    (_, _, form), _ = columns
    figure = {"value": -816.8, "low": -900.0, "high": -0.5}
    assert format_interval(figure, form) == "< -1"
    assert format_interval({**figure, "value": -0.7}, form) == "-0.70 [< -1, -0.50]"
