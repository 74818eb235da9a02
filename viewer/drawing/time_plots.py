"""Draw values over time; the title of a panel has the unit.

Styles are logged once but requested for every batch, so they are cached.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyarrow as pa
import rerun as rr

from dmrl.colours import OWN_RGB, PEER_RGB, RGB, STATUS_RGB
from dmrl.geometry.frames import Array
from dmrl.messages import find_descriptor
from dmrl.topics import RANGE, Topic
from dmrl.viewer.content.robot_motion import Positions
from dmrl.viewer.drawing.archetypes import Colour, row_indices
from dmrl.viewer.drawing.entity import Entity

SIGHT_COLOURS = (("detected", STATUS_RGB["OK"]), ("not detected", STATUS_RGB["AMBIGUOUS"]))
BOUND_SIGMAS = 3.0
NEES_95_LIMIT = 5.991
"""95th percentile of a chi-square distribution with two degrees of freedom."""

_RED, _GREEN, _BLUE = RGB["estimate"]
DIM_ESTIMATE: Colour = (_RED // 2, _GREEN // 2, _BLUE // 2)
WIDTH_UI, THIN_UI, MARKER_UI = 1.5, 0.8, 0.8


def draw_line(
    path: str,
    values: Array,
    name: str,
    colour: Colour,
    width: float = WIDTH_UI,
    *,
    exact: bool = False,
) -> Entity:
    """Draw one line from (N,) values; NaN leaves a gap.

    ``exact`` draws every point; else rerun joins those of one pixel, and steps become slopes.
    """
    style = _line_style((colour,), (name,), width, exact=exact)
    return Entity(path, rr.Scalars.columns(scalars=values), (style,))


@cache
def _line_style(
    colours: tuple[Colour, ...], names: tuple[str, ...], width: float, *, exact: bool = False
) -> rr.SeriesLines:
    policy = rr.components.AggregationPolicy.Off if exact else None
    return rr.SeriesLines(
        colors=colours, names=names, widths=[width] * len(names), aggregation_policy=policy
    )


def draw_dots(path: str, values: Array, name: str, colour: Colour) -> Entity:
    """Draw (N,) values as dots, for values that scatter too much for a line."""
    return Entity(path, rr.Scalars.columns(scalars=values), (_dot_style(name, colour),))


@cache
def _dot_style(name: str, colour: Colour) -> rr.SeriesPoints:
    return rr.SeriesPoints(colors=[colour], names=[name], marker_sizes=[MARKER_UI])


def draw_sensor(
    topic: str, batch: pa.RecordBatch, row: Topic, robot: str, *, own: bool
) -> Iterator[Entity]:
    """Draw a sensor as the table of topics defines: lines for a robot, dots for a pair."""
    if row.curve is None:
        return
    for path, fields in row.curve.list_lines(topic).items():
        parts = [batch[field].to_numpy(zero_copy_only=False) for field in fields]
        values = np.hypot.reduce(parts) if len(parts) > 1 else parts[0]
        which = [] if path == topic else [fields[0]]
        if row.is_pairwise:
            kind = row.curve.name or topic.split("/")[2]
            colour = RGB["range" if row.pattern == RANGE else "other"]
            yield draw_dots(path, values, " ".join([kind, *which]), colour)
        else:
            name = " ".join([robot, *([row.curve.name] if row.curve.name else []), *which])
            yield draw_line(path, values, name, OWN_RGB if own else PEER_RGB)


@dataclass(slots=True)
class AttitudePlot:
    """Draw roll, pitch and yaw of a robot, degrees, across batches.

    Yaw is unwrapped, so it does not jump from 180 to -180. It starts within 180 of zero and
    continues from the end of the batch before.
    """

    path: str
    robot: str
    own: bool
    last_deg: float = 0.0
    last_ns: int = -1

    def draw_rows(self, batch: pa.RecordBatch) -> Iterator[Entity]:
        """Draw the next rows."""
        for name, colour in (("roll", OWN_RGB), ("pitch", PEER_RGB)):
            degrees = np.degrees(batch[f"{name}_rad"].to_numpy())
            yield draw_line(f"{self.path}/{name}", degrees, name, colour)
        colour = OWN_RGB if self.own else PEER_RGB
        yield draw_line(f"{self.path}/yaw", self._unwrap_yaw(batch), self.robot, colour)

    def _unwrap_yaw(self, batch: pa.RecordBatch) -> Array:
        degrees: Array = np.degrees(batch["yaw_rad"].to_numpy())
        time_ns = batch["log_time"].to_numpy()
        # Earlier times belong to another recording or pass, which starts anew.
        before = self.last_deg if time_ns[0] >= self.last_ns else 0.0
        known = np.isfinite(degrees)
        if known.any():
            degrees[known] = np.unwrap(np.append(before, degrees[known]), period=360.0)[1:]
            self.last_deg = float(degrees[known][-1])
        self.last_ns = int(time_ns[-1])
        return degrees


def draw_distance(path: str, positions: Positions, source: str) -> Entity:
    """Draw the distance of a peer."""
    values = np.linalg.norm(positions.xyz, axis=1)
    return draw_line(f"{path}/distance", values, source, RGB[source])


def draw_errors(path: str, positions: Positions, truth: Positions) -> Iterator[Entity]:
    """Draw the error along x and y with its 3-sigma bounds, and the NEES of both."""
    error = (positions.xyz - truth.interpolate(positions.time_ns))[:, :2]
    covariance = positions.covariance[:, :2, :2]
    bound = BOUND_SIGMAS * np.sqrt(np.einsum("nii->ni", covariance))
    for k, axis in enumerate("xy"):
        both = np.stack([bound[:, k], -bound[:, k]], axis=1)
        style = _line_style((DIM_ESTIMATE, DIM_ESTIMATE), ("3 sigma", "3 sigma"), THIN_UI)
        yield Entity(f"{path}/bound/{axis}", rr.Scalars.columns(scalars=both), (style,))
        yield draw_line(f"{path}/error/{axis}", error[:, k], "estimate", RGB["estimate"])
    yield draw_line(f"{path}/nees", _compute_nees(error, covariance), "estimate", RGB["estimate"])
    limit = np.full(len(error), NEES_95_LIMIT)
    yield draw_line(f"{path}/nees/limit", limit, "95 % limit", PEER_RGB, THIN_UI)


def _compute_nees(error: Array, covariance: Array) -> Array:
    """Return squared errors divided by their covariance, (N,); NaN where it is unknown or zero."""
    given = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(error).all(axis=1)
    spread = np.linalg.det(np.where(np.reshape(given, (-1, 1, 1)), covariance, 0.0))
    known = np.flatnonzero(spread > 0)
    out = np.full(len(error), np.nan)
    solved = np.linalg.solve(covariance[known], error[known][:, :, None])[:, :, 0]
    out[known] = np.einsum("ni,ni->n", error[known], solved)
    return out


def draw_sight(path: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Draw as a band in which images a peer was detected."""
    column = batch["detections"]
    least = batch["threshold"].to_numpy()[row_indices(column)]
    believed = column.flatten().field("confidence").to_numpy() >= least
    number = np.bincount(row_indices(column)[believed], minlength=batch.num_rows)
    states = np.where(number > 0, "detected", "not detected").tolist()
    style = _state_style(SIGHT_COLOURS)
    yield Entity(f"{path}/sight", rr.StateChange.columns(state=states), (style,))


def draw_status(path: str, positions: Positions) -> Iterator[Entity]:
    """Draw the status of the estimates as a band."""
    kind = find_descriptor("PeerPosition").fields_by_name["status"].enum_type
    names = {} if kind is None else {n: v.name for n, v in kind.values_by_number.items()}
    states = [names.get(number, str(number)) for number in positions.status.tolist()]
    style = _state_style(tuple(STATUS_RGB.items()))
    yield Entity(f"{path}/status", rr.StateChange.columns(state=states), (style,))


@cache
def _state_style(colours: tuple[tuple[str, Colour], ...]) -> rr.StateConfiguration:
    names = [name for name, _ in colours]
    packed = np.array([_pack_rgba(colour) for _, colour in colours], np.uint32)
    return rr.StateConfiguration(values=names, labels=names, colors=packed)


def _pack_rgba(colour: Sequence[int]) -> int:
    return int.from_bytes(bytes([*colour, 255]))
