"""Draw what `dmrl label` found wrong with the sensors of a pair: innovations and causes."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.colours import OWN_RGB, PEER_RGB, RGB
from dmrl.viewer.content.robot_motion import Names, Times
from dmrl.viewer.drawing.archetypes import Colour
from dmrl.viewer.drawing.entity import Entity
from dmrl.viewer.drawing.time_plots import draw_line
from dmrl.viewer.layouts import PlotPanel

SIGNAL_RGB = {"range": RGB["range"], "flow": RGB["estimate"], "yaw rate": RGB["published"]}
"""Colours of the signals. Others have the colour of detections; those of the peer are darker."""
EDGE_S = 1e-3
"""Seconds from the start of a cause to the zero before it: a plot joins its points by lines."""

Message = Mapping[str, Any]


def list_cause_panels(pair: Names, message: Message) -> list[PlotPanel]:
    """Return the panels of a pair's PeerCauses message that have data."""
    lines = {
        "innovations, sigmas": [one[0] for one in _list_innovations(pair, message)],
        "causes, probability": [one[0] for one in _list_causes(pair, message)],
    }
    return [PlotPanel(title, tuple(paths)) for title, paths in lines.items() if paths]


def draw_causes(pair: Names, message: Message) -> Iterator[tuple[Times, Entity]]:
    """Draw the sizes of innovations and the probabilities of causes over time."""
    message = {"innovations": (), **message}  # earlier versions have none
    for path, name, robot, one in _list_innovations(pair, message):
        colour = SIGNAL_RGB.get(one["signal"], RGB["detection"])
        line = draw_line(path, np.array(one["size"]), name, _darken(colour, robot, pair))
        yield _to_times(message, one["at_s"]), line
    ends = [0.0, *(one["at_s"][-1] for one in message["innovations"] if one["at_s"])]
    for path, name, robot, some in _list_causes(pair, message):
        at_s, values = _build_steps(some, max(ends))
        colour = PEER_RGB if robot == pair[1] else OWN_RGB
        yield _to_times(message, at_s), draw_line(path, values, name, colour, exact=True)


def _build_steps(stretches: Sequence[Message], end_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and probabilities of a cause from 0 to the end; 0 between its stretches."""
    steps = [
        (at_s, 0.0)
        for at_s in (0.0, end_s)
        if not any(one["from_s"] <= at_s <= one["to_s"] for one in stretches)
    ]
    for one in stretches:
        begin_s, stop_s, probability = one["from_s"], one["to_s"], one["probability"]
        steps += [(begin_s - EDGE_S, 0.0), (begin_s, probability)]
        steps += [(stop_s, probability), (stop_s + EDGE_S, 0.0)]
    at_s, values = np.array(sorted(steps)).T
    return at_s, values


def _list_innovations(pair: Names, message: Message) -> list[tuple[str, str, str, Message]]:
    """Return path, name, robot and content of each innovation."""
    out = []
    for one in message.get("innovations", ()):
        name = " ".join([one["robot"], one["signal"]]).strip()
        out.append((_build_path(pair, "innovation", name), name, one["robot"], one))
    return out


def _list_causes(pair: Names, message: Message) -> list[tuple[str, str, str, Sequence[Message]]]:
    """Return path, name, robot and stretches of each cause."""
    found: dict[tuple[str, str], list[Message]] = {}
    for one in message["causes"]:
        found.setdefault((one["robot"], one["name"]), []).append(one)
    names = {key: " ".join(key).strip() for key in found}
    return [
        (_build_path(pair, "cause", names[key]), names[key], key[0], some)
        for key, some in found.items()
    ]


def _build_path(pair: Names, kind: str, name: str) -> str:
    return f"{topics.CAUSES(*pair)}/{kind}/{name.replace(' ', '_')}"


def _darken(colour: Colour, robot: str, pair: Names) -> Colour:
    red, green, blue = colour
    return (red // 2, green // 2, blue // 2) if robot == pair[1] else colour


def _to_times(message: Message, at_s: Sequence[float] | np.ndarray) -> Times:
    """Return log times of seconds after a message."""
    return np.asarray(message["log_time"] + np.rint(np.array(at_s) * 1e9).astype(np.int64))
