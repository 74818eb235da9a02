"""Figures of a recipe: their specification is checked, and values are found in JSON files."""

from typing import Any

import pytest

from dmrl.errors import RecipeError
from dmrl.evaluation.figure_specs import find_value, iter_faults, read_figures

OUTS = {"model", "judged", "a.mcap"}
GOOD = {"title": "Losses", "shows": "losses", "of": ["model"]}


def list_faults(table: Any) -> str:
    """Return the faults of a figure's table in one line."""
    return "; ".join(iter_faults({"figure": [table]}, OUTS))


def test_valid_figure_specs_are_read() -> None:
    rows = [{"what": "px", "of": "judged/evaluation.json", "at": "overall.median_px.value"}]
    numbers = {"title": "Numbers", "shows": "numbers", "rows": rows}
    recipe = {"title": "Mine", "figure": [GOOD, numbers]}
    assert not list(iter_faults(recipe, OUTS))
    first, second = read_figures("mine", recipe)
    assert first.of == ("model",) and first.output_label(0) == "model"
    assert second.rows[0].at == "overall.median_px.value" and second.rows[0].form == ".3g"
    assert second.outputs == ["judged/evaluation.json"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"shows": "pies"}, "figure.1.shows"),
        ({"of": []}, "losses needs of"),
        ({"of": ["elsewhere"]}, "no step writes elsewhere"),
        ({"of": ["model/../../etc"]}, "no step writes model/../../etc"),
        ({"of": [], "rows": []}, "losses needs of, and no rows"),
        ({"named": ["a", "b"]}, "more words than there are outputs"),
        ({"colour": "red"}, "figure.1.colour"),
    ],
)
def test_a_wrong_figure_is_a_fault_of_the_recipe(change: dict[str, Any], says: str) -> None:
    assert says in list_faults(GOOD | change)


@pytest.mark.parametrize(
    "form", ["{}", "999999999.1f", "1000000000", "*>900000000f", ".999999999f"]
)
def test_invalid_or_oversized_number_format_is_a_fault(form: str) -> None:
    row = {"what": "px", "of": "judged", "at": "x", "form": form}
    assert "is not a number format" in list_faults(
        {"title": "N", "shows": "numbers", "rows": [row]}
    )


def test_invalid_tables_are_faults() -> None:
    assert "must be [[figure]] tables" in "".join(iter_faults({"figure": 3}, OUTS))
    assert "must be a table" in list_faults("losses")
    with pytest.raises(RecipeError, match="must be"):
        read_figures("mine.toml", {"figure": 3})
    assert "title: must be a text" in "".join(iter_faults({"title": 3}, OUTS))


@pytest.mark.parametrize(
    ("at", "value"),
    [
        ("a.b", 3),
        ("rows.1.x", 6),
        ("rows.-1.x", 6),
        ("rows.gcc.x", 5),
        ("rows.7.x", None),
        ("rows.clang.x", None),
        ("a", None),
        ("a.b.c", None),
        ("none", None),
    ],
)
def test_value_is_found_by_its_path_in_a_document(at: str, value: int | None) -> None:
    document = {"a": {"b": 3}, "rows": [{"name": "gcc", "x": 5}, {"name": "riscv32", "x": 6}]}
    assert find_value(document, at) == value
