"""The report's section on provenance: all stages, evaluations included, with their settings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dmrl.html_report.blocks import Row, Table
from dmrl.html_report.collect import ReportInputs
from dmrl.html_report.provenance_section import build_provenance_section
from dmrl.recording import Input, Provenance


def report(document: Mapping[str, Any], *names: str) -> tuple[str, list[Any]]:
    """Return the graph, and what made the outputs."""
    settings = {"views": 1, "lens": None, "vision": {"lost_share": 0.0, "lost": [0, 1], "no": {}}}
    made = Provenance("predict", settings, inputs=(Input("flight.mcap", "1"),))
    found = ReportInputs(
        Path("demo"),
        made=dict.fromkeys(names, made),
        documents={"evaluations": {"judged": document}},
    )
    drawn, outputs, _ = build_provenance_section(found)
    assert isinstance(drawn, Row)
    assert isinstance(outputs, Table)
    return drawn.figures[0].svg, list(outputs.rows)


def test_evaluations_are_in_the_graph_behind_their_recording() -> None:
    svg, _ = report({"recording": {"name": "seen.mcap", "sha256": "2"}}, "seen.mcap")
    assert svg.count("<rect") == 3  # the boxes: a file, predict, evaluate
    assert "evaluate" in svg
    assert "file seen.mcap" not in svg


def test_a_recording_that_is_elsewhere_or_there_twice_is_a_source() -> None:
    document = {"recording": {"name": "seen.mcap", "sha256": "2"}}
    for names in (["other.mcap"], ["a/seen.mcap", "b/seen.mcap"]):
        assert "file seen.mcap" in report(document, *names)[0]


@pytest.mark.parametrize("document", [{}, {"recording": "seen.mcap"}, {"recording": {"name": 3}}])
def test_documents_of_another_form_do_no_harm(document: dict[str, Any]) -> None:
    assert "predict" in report(document, "seen.mcap")[0]


def test_settings_in_tables_are_written_as_in_a_recipe() -> None:
    _, rows = report({}, "seen.mcap")
    said = "dmrl predict views=1 vision.lost_share=0.0 vision.lost=[0, 1]"
    assert rows == [("seen.mcap", said)]
