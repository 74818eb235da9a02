"""The Foxglove layout names existing topics, fields and colours."""

import json
import re
from collections.abc import Iterator
from importlib.resources import files
from typing import Any

import pytest

from dmrl import topics
from dmrl.colours import OWN_RGB, PEER_RGB, RGB
from dmrl.messages import find_descriptor

LAYOUT: dict[str, Any] = json.loads(
    files("dmrl.viewer").joinpath("foxglove.json").read_text(encoding="utf-8")
)
PANELS = LAYOUT["configById"]
LINES = [(name, line) for name, panel in PANELS.items() for line in panel.get("paths", ())]


def iter_panels(node: Any) -> Iterator[str]:
    """Yield the panels of a layout."""
    if isinstance(node, str):
        yield node
    else:
        yield from iter_panels(node["first"])
        yield from iter_panels(node["second"])


def test_every_panel_is_in_the_layout_once() -> None:
    assert sorted(iter_panels(LAYOUT["layout"])) == sorted(PANELS)
    assert all(panel["foxglovePanelTitle"] for panel in PANELS.values())


@pytest.mark.parametrize("line", [line for _, line in LINES], ids=lambda line: line["value"])
def test_every_line_is_a_field_of_a_message(line: dict[str, Any]) -> None:
    topic, _, path = line["value"].partition(".")
    row = topics.find_topic(topic)
    assert row is not None
    kind: Any = find_descriptor(row.message)
    for part in re.sub(r"\[[^]]*\]|\{[^}]*\}", "", path).split("."):
        assert part in kind.fields_by_name
        kind = kind.fields_by_name[part].message_type


def test_images_and_frusta_are_topics_that_foxglove_draws() -> None:
    cameras = [panel["imageMode"] for name, panel in PANELS.items() if name.startswith("Image!")]
    named = [topic for mode in cameras for topic in mode.values()]
    named += PANELS["3D!space"]["topics"]
    rows = [topics.find_topic(topic) for topic in named]
    assert {row.message for row in rows if row is not None} == {
        "foxglove.CompressedImage",
        "foxglove.CameraCalibration",
    }
    assert None not in rows


def test_colours_equal_those_of_other_views() -> None:
    known = {f"#{bytes(colour).hex()}" for colour in (*RGB.values(), OWN_RGB, PEER_RGB)}
    assert {line["color"] for _, line in LINES if "color" in line} <= known


def test_every_plot_names_its_unit() -> None:
    units = ("m", "rad", "px", "detection")
    titles = [panel["foxglovePanelTitle"] for name, panel in PANELS.items() if "Plot!" in name]
    assert [title for title in titles if title.split()[-1] not in units] == []
