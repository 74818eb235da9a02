"""Poses and relative positions of robots as arrays, for 3D views and plots."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.estimation.model.position_metrics import MAX_TRUTH_GAP_S
from dmrl.geometry.frames import Array
from dmrl.recording import Summary, sample_topics
from dmrl.viewer.drawing.entity import WORLD_FRAME, horizontal_frame

Times = NDArray[np.int64]
Names = tuple[str, str]
MAX_DRAWN = 1e9
"""Largest length in metres, or part of a quaternion, that is drawn; recordings may have any
value."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of a frame in its parent.

    Parameters
    ----------
    parent
        Parent frame.
    time_ns
        (N,) log times, sorted, at least one.
    xyz, xyzw
        (N, 3) metres and (N, 4) unit quaternions.
    """

    parent: str
    time_ns: Times
    xyz: Array
    xyzw: Array

    def find_changes(self, last: "Poses | None") -> NDArray[np.bool_]:
        """Return where a pose differs from the one before it, (N,); ``last`` precedes the first."""
        poses = np.concatenate([self.xyz, self.xyzw], axis=1)
        moved = np.ones(len(poses), np.bool_)
        moved[1:] = (poses[1:] != poses[:-1]).any(axis=1)
        if last is not None and last.parent == self.parent:
            before = np.concatenate([last.xyz[-1], last.xyzw[-1]])
            moved[0] = (poses[0] != before).any()
        return moved

    def to_parent(self, points: Array, time_ns: Times) -> Array:
        """Transform (M, 3) points at (M,) times to the parent; poses are interpolated."""
        after = np.searchsorted(self.time_ns, time_ns).clip(0, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self.time_ns[after] - self.time_ns[before], 1)
        share = np.clip((time_ns - self.time_ns[before]) / span, 0.0, 1.0)[:, None]
        ends = self.xyzw[before], self.xyzw[after]
        # A quaternion and its negative are the same rotation.
        near = np.sign((ends[0] * ends[1]).sum(axis=1, keepdims=True))
        turn = (1 - share) * ends[0] + share * near * ends[1]
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        # Rotation by a unit quaternion: p + 2 v x (v x p + w p).
        axis, w = turn[:, :3], turn[:, 3:]
        turned = points + 2 * np.cross(axis, np.cross(axis, points) + w * points)
        place = (1 - share) * self.xyz[before] + share * self.xyz[after]
        return np.asarray(turned + place)


@dataclass(frozen=True, slots=True)
class Positions:
    """Positions of a peer relative to a robot.

    Parameters
    ----------
    time_ns
        (N,) log times, sorted.
    xyz
        (N, 3) in the robot's horizontal frame, metres.
    covariance
        (N, 3, 3) square metres; NaN where unknown.
    status
        (N,) numbers of ``dmrl.v1.Status``.
    """

    time_ns: Times
    xyz: Array
    covariance: Array
    status: NDArray[np.int32]

    def interpolate(self, time_ns: Times) -> Array:
        """Interpolate positions linearly at (M,) times, (M, 3); NaN in long gaps."""
        if not len(self.time_ns):
            return np.full((len(time_ns), 3), np.nan)
        after = np.searchsorted(self.time_ns, time_ns).clip(0, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        near = np.minimum(abs(self.time_ns[after] - time_ns), abs(self.time_ns[before] - time_ns))
        axes = [np.interp(time_ns, self.time_ns, axis) for axis in self.xyz.T]
        return np.where((near <= MAX_TRUTH_GAP_S * 1e9)[:, None], np.stack(axes, axis=1), np.nan)


@dataclass(frozen=True, slots=True)
class Ranges:
    """Measured distances: (N,) log times, sorted, and metres."""

    time_ns: Times
    range_m: Array


Timed = Poses | Positions | Ranges
Kind = TypeVar("Kind", bound=Timed)


def select_rows(timed: Kind, rows: slice | NDArray[np.int64]) -> Kind:
    """Select some rows."""
    return _map_columns(timed, lambda name: getattr(timed, name)[rows])


def concatenate_parts(parts: Sequence[Kind]) -> Kind:
    """Concatenate parts and sort their rows by log time."""
    if len(parts) == 1:
        return parts[0]
    whole = _map_columns(parts[0], lambda name: np.concatenate([getattr(p, name) for p in parts]))
    if (np.diff(whole.time_ns) >= 0).all():
        return whole
    return select_rows(whole, np.argsort(whole.time_ns, kind="stable"))


def _map_columns(timed: Kind, column: Callable[[str], NDArray[Any]]) -> Kind:
    """Replace every array by the column of that name."""
    values: dict[str, Any] = {one.name: getattr(timed, one.name) for one in fields(timed)}
    columns = {name: column(name) for name, v in values.items() if isinstance(v, np.ndarray)}
    return type(timed)(**(values | columns))


@dataclass(frozen=True, slots=True)
class FlightMotion:
    """Poses by frame, and positions by robot and peer, of some recordings."""

    poses: Mapping[str, Poses] = field(default_factory=dict)
    estimates: Mapping[Names, Positions] = field(default_factory=dict)
    truths: Mapping[Names, Positions] = field(default_factory=dict)

    def display_frame(self, robot: str) -> str:
        """Return the frame in which a robot is shown: the world, or else its own."""
        own = horizontal_frame(robot)
        return WORLD_FRAME if own in self.poses and self.poses[own].parent == WORLD_FRAME else own


def sample_motion(
    recordings: Mapping[Path, Summary], pairs: Iterable[Names], start_ns: int, end_ns: int
) -> FlightMotion:
    """Sample the motion in [start_ns, end_ns): every frame and pair, and their extent."""
    pairs = list(pairs)
    kinds = {topics.POSITION(*pair): ("estimates", pair) for pair in pairs}
    kinds |= {topics.TRUTH(*pair): ("truths", pair) for pair in pairs}
    wanted: dict[str, Sequence[str] | None] = dict.fromkeys([*kinds, topics.TRANSFORMS])
    found: dict[str, list[pa.RecordBatch]] = {}
    for path in recordings:
        for topic, batch in sample_topics(path, wanted, start_ns=start_ns, end_ns=end_ns).items():
            found.setdefault(topic, []).append(batch)
    held: dict[str, dict[Names, Positions]] = {"estimates": {}, "truths": {}}
    for topic, (kind, pair) in kinds.items():
        if topic in found:
            held[kind][pair] = concatenate_parts([parse_positions(batch) for batch in found[topic]])
    poses: dict[str, list[Poses]] = {}
    for batch in found.get(topics.TRANSFORMS, ()):
        for frame, part in parse_poses(batch).items():
            poses.setdefault(frame, []).append(part)
    return FlightMotion({frame: concatenate_parts(parts) for frame, parts in poses.items()}, **held)


def parse_poses(batch: pa.RecordBatch) -> dict[str, Poses]:
    """Read the poses by frame from columns of foxglove.FrameTransforms."""
    column = batch["transforms"]
    rows = np.repeat(np.arange(len(column)), column.value_lengths().to_numpy())
    parts = column.flatten()
    time_ns = batch["log_time"].to_numpy()[rows]
    xyz = parse_vectors(parts.field("translation"), "xyz")
    xyzw = parse_vectors(parts.field("rotation"), "xyzw")
    children = parts.field("child_frame_id").to_numpy(zero_copy_only=False)
    out = {}
    for frame in dict.fromkeys(children):
        own = np.flatnonzero(children == frame)
        parent = parts.field("parent_frame_id")[int(own[0])].as_py()
        out[frame] = Poses(parent, time_ns[own], xyz[own], _normalize_quaternions(xyzw[own]))
    return out


def _normalize_quaternions(xyzw: Array) -> Array:
    """Normalize quaternions to length one; NaN where all parts are zero."""
    length = np.linalg.norm(xyzw, axis=1, keepdims=True)
    return xyzw / np.where(length > 0, length, np.nan)


def _mask_undrawable(values: Array) -> Array:
    """Replace values that are too large to draw by NaN."""
    return np.where(abs(values) < MAX_DRAWN, values, np.nan)


def parse_positions(batch: pa.RecordBatch) -> Positions:
    """Read the columns of PeerPosition."""
    xyz = np.stack([batch[axis].to_numpy() for axis in "xyz"], axis=1)
    covariance = parse_covariances(batch["covariance"])
    time_ns, status = (batch[name].to_numpy() for name in ("log_time", "status"))
    return Positions(time_ns, _mask_undrawable(xyz), covariance, status)


def parse_ranges(batch: pa.RecordBatch) -> Ranges:
    """Read the columns of UwbRange."""
    return Ranges(batch["log_time"].to_numpy(), _mask_undrawable(batch["range_m"].to_numpy()))


def parse_covariances(column: pa.ListArray) -> Array:
    """Read a list column of covariances, (N, 3, 3); NaN where missing."""
    given = column.value_lengths().to_numpy() == 9
    out = np.full((len(column), 3, 3), np.nan)
    out[given] = column.filter(pa.array(given)).flatten().to_numpy().reshape(-1, 3, 3)
    return _mask_undrawable(out)


def parse_vectors(column: pa.StructArray, axes: str) -> Array:
    """Read these fields of a column of structs, (N, k); NaN where too large to draw."""
    return _mask_undrawable(np.stack([column.field(axis).to_numpy() for axis in axes], axis=1))
