"""What is plotted over time, every line with its unit in the name of its panel.

Styles are logged once, but asked for with every stretch: they are made once too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyarrow as pa
import rerun as rr

from dmrl.colours import OWN, PEER, RGB, STATUS_RGB
from dmrl.geometry.frames import Array
from dmrl.messages import descriptor
from dmrl.topics import RANGE, Topic
from dmrl.viewer.content.robot_motion import Positions
from dmrl.viewer.drawing.archetypes import Colour
from dmrl.viewer.drawing.entity import Entity

BOUND_SIGMAS = 3.0
NEES_95 = 5.991
"""95 % of a chi-square with two degrees of freedom lie below."""

_RED, _GREEN, _BLUE = RGB["estimate"]
DIM_ESTIMATE: Colour = (_RED // 2, _GREEN // 2, _BLUE // 2)
WIDTH_UI, THIN_UI, MARKER_UI = 1.5, 0.8, 0.8


def line(path: str, values: Array, name: str, colour: Colour, width: float = WIDTH_UI) -> Entity:
    """One line: (N,) values; where they are NaN, it has a gap."""
    style = _lines((colour,), (name,), width)
    return Entity(path, rr.Scalars.columns(scalars=values), (style,))


@cache
def _lines(colours: tuple[Colour, ...], names: tuple[str, ...], width: float) -> rr.SeriesLines:
    return rr.SeriesLines(colors=colours, names=names, widths=[width] * len(names))


def dots(path: str, values: Array, name: str, colour: Colour) -> Entity:
    """(N,) values that scatter too much for a line."""
    return Entity(path, rr.Scalars.columns(scalars=values), (_dots(name, colour),))


@cache
def _dots(name: str, colour: Colour) -> rr.SeriesPoints:
    return rr.SeriesPoints(colors=[colour], names=[name], marker_sizes=[MARKER_UI])


def sensor(
    topic: str, batch: pa.RecordBatch, row: Topic, robot: str, *, own: bool
) -> Iterator[Entity]:
    """What the table of topics says of a sensor: lines of the robot, dots of a pair."""
    if row.curve is None:
        return
    for path, fields in row.curve.lines(topic).items():
        parts = [batch[field].to_numpy(zero_copy_only=False) for field in fields]
        values = np.hypot.reduce(parts) if len(parts) > 1 else parts[0]
        which = [] if path == topic else [fields[0]]
        if row.of_pairs:
            kind = row.curve.name or topic.split("/")[2]
            colour = RGB["range" if row.pattern == RANGE else "other"]
            yield dots(path, values, " ".join([kind, *which]), colour)
        else:
            name = " ".join([robot, *([row.curve.name] if row.curve.name else []), *which])
            yield line(path, values, name, OWN if own else PEER)


@dataclass(slots=True)
class Attitude:
    """Roll, pitch and yaw of a robot, degrees, stretch by stretch.

    A robot that turns on past 180 is drawn past 180: there is no jump to -180. Yaw begins within
    180 of zero and goes on where the stretch before ended.
    """

    path: str
    robot: str
    own: bool
    last_deg: float = 0.0
    last_ns: int = -1

    def draw(self, batch: pa.RecordBatch) -> Iterator[Entity]:
        """Some rows more."""
        for name, colour in (("roll", OWN), ("pitch", PEER)):
            degrees = np.degrees(batch[f"{name}_rad"].to_numpy())
            yield line(f"{self.path}/{name}", degrees, name, colour)
        colour = OWN if self.own else PEER
        yield line(f"{self.path}/yaw", self._yaw(batch), self.robot, colour)

    def _yaw(self, batch: pa.RecordBatch) -> Array:
        degrees: Array = np.degrees(batch["yaw_rad"].to_numpy())
        time_ns = batch["log_time"].to_numpy()
        # Another recording, or another pass, begins anew.
        before = self.last_deg if time_ns[0] >= self.last_ns else 0.0
        known = np.isfinite(degrees)
        if known.any():
            degrees[known] = np.unwrap(np.append(before, degrees[known]), period=360.0)[1:]
            self.last_deg = float(degrees[known][-1])
        self.last_ns = int(time_ns[-1])
        return degrees


def distance(path: str, positions: Positions, source: str) -> Entity:
    """How far away a peer is thought to be."""
    values = np.linalg.norm(positions.xyz, axis=1)
    return line(f"{path}/distance", values, source, RGB[source])


def errors(path: str, positions: Positions, truth: Positions) -> Iterator[Entity]:
    """Estimate minus truth with three standard deviations, along x and y; NEES of both."""
    error = (positions.xyz - truth.at(positions.time_ns))[:, :2]
    covariance = positions.covariance[:, :2, :2]
    bound = BOUND_SIGMAS * np.sqrt(np.einsum("nii->ni", covariance))
    for k, axis in enumerate("xy"):
        both = np.stack([bound[:, k], -bound[:, k]], axis=1)
        style = _lines((DIM_ESTIMATE, DIM_ESTIMATE), ("3 sigma", "3 sigma"), THIN_UI)
        yield Entity(f"{path}/bound/{axis}", rr.Scalars.columns(scalars=both), (style,))
        yield line(f"{path}/error/{axis}", error[:, k], "estimate", RGB["estimate"])
    yield line(f"{path}/nees", _nees(error, covariance), "estimate", RGB["estimate"])
    limit = np.full(len(error), NEES_95)
    yield line(f"{path}/nees/limit", limit, "95 % are below", PEER, THIN_UI)


def _nees(error: Array, covariance: Array) -> Array:
    """(N,) squared errors in units of their covariance; NaN where it is unknown or zero."""
    given = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(error).all(axis=1)
    spread = np.linalg.det(np.where(np.reshape(given, (-1, 1, 1)), covariance, 0.0))
    known = np.flatnonzero(spread > 0)
    out = np.full(len(error), np.nan)
    solved = np.linalg.solve(covariance[known], error[known][:, :, None])[:, :, 0]
    out[known] = np.einsum("ni,ni->n", error[known], solved)
    return out


def status(path: str, positions: Positions) -> Iterator[Entity]:
    """How far the estimates can be trusted, as a band."""
    kind = descriptor("PeerPosition").fields_by_name["status"].enum_type
    names = {} if kind is None else {n: v.name for n, v in kind.values_by_number.items()}
    states = [names.get(number, str(number)) for number in positions.status.tolist()]
    yield Entity(f"{path}/status", rr.StateChange.columns(state=states), (_states(),))


@cache
def _states() -> rr.StateConfiguration:
    return rr.StateConfiguration(
        values=list(STATUS_RGB),
        labels=list(STATUS_RGB),
        colors=np.array([_rgba(colour) for colour in STATUS_RGB.values()], np.uint32),
    )


def _rgba(colour: Sequence[int]) -> int:
    return int.from_bytes(bytes([*colour, 255]))
