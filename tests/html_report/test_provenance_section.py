"""The section on provenance shows all stages, also evaluations, with their settings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dmrl.html_report.blocks import Row, Table
from dmrl.html_report.collect import ReportInputs
from dmrl.html_report.provenance_section import build_provenance_section
from dmrl.recording import Input, Provenance


def build_section(document: Mapping[str, Any], *names: str) -> tuple[str, list[Any]]:
    """Return the graph as SVG, and the rows of the table of outputs."""
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
    svg, _ = build_section({"recording": {"name": "seen.mcap", "sha256": "2"}}, "seen.mcap")
    assert svg.count("<rect") == 3  # boxes of the file, predict and evaluate
    assert "evaluate" in svg
    assert "file seen.mcap" not in svg


def test_a_recording_that_is_elsewhere_or_there_twice_is_a_source() -> None:
    document = {"recording": {"name": "seen.mcap", "sha256": "2"}}
    for names in (["other.mcap"], ["a/seen.mcap", "b/seen.mcap"]):
        assert "file seen.mcap" in build_section(document, *names)[0]


@pytest.mark.parametrize("document", [{}, {"recording": "seen.mcap"}, {"recording": {"name": 3}}])
def test_invalid_documents_are_ignored_in_the_graph(document: dict[str, Any]) -> None:
    assert "predict" in build_section(document, "seen.mcap")[0]


def test_settings_in_tables_are_written_as_in_a_recipe() -> None:
    _, rows = build_section({}, "seen.mcap")
    said = "dmrl predict views=1 vision.lost_share=0.0 vision.lost=[0, 1]"
    assert rows == [("seen.mcap", said)]
