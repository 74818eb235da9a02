"""Where robots are and see each other, as arrays: what 3D views and plots are made from.

Positions of a whole flight are held, 200 bytes each: 15 MB an hour for a pair.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.geometry import Array
from dmrl.positions import GAP_S
from dmrl.recording import Summary, glance, stretches
from dmrl.viewer.entity import WORLD, horizontal_frame

Times = NDArray[np.int64]
Names = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Poses:
    """Where a frame is in its parent.

    Parameters
    ----------
    parent
        Frame.
    time_ns
        (N,) log times, sorted, at least one.
    xyz, xyzw
        (N, 3) metres and (N, 4) unit quaternions.
    """

    parent: str
    time_ns: Times
    xyz: Array
    xyzw: Array

    @property
    def fixed(self) -> bool:
        """Whether it never moves."""
        return bool((self.xyz == self.xyz[0]).all() and (self.xyzw == self.xyzw[0]).all())

    def applied(self, points: Array, time_ns: Times) -> Array:
        """(M, 3) points at (M,) times, in the parent; between two poses on the way of both."""
        after = np.searchsorted(self.time_ns, time_ns).clip(0, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self.time_ns[after] - self.time_ns[before], 1)
        share = np.clip((time_ns - self.time_ns[before]) / span, 0.0, 1.0)[:, None]
        ends = self.xyzw[before], self.xyzw[after]
        # A quaternion and its negative are the same turn.
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
    """Where one robot sees another.

    Parameters
    ----------
    time_ns
        (N,) log times, sorted.
    xyz
        (N, 3) in the robot's horizontal frame, metres.
    covariance
        (N, 3, 3) square metres; NaN where it is not known.
    status
        (N,) numbers of ``dmrl.v1.Status``.
    """

    time_ns: Times
    xyz: Array
    covariance: Array
    status: NDArray[np.int32]

    def at(self, time_ns: Times) -> Array:
        """(M, 3) positions at (M,) times, on straight lines; NaN over long gaps."""
        if not len(self.time_ns):
            return np.full((len(time_ns), 3), np.nan)
        after = np.searchsorted(self.time_ns, time_ns).clip(0, len(self.time_ns) - 1)
        before = np.maximum(after - 1, 0)
        near = np.minimum(abs(self.time_ns[after] - time_ns), abs(self.time_ns[before] - time_ns))
        axes = [np.interp(time_ns, self.time_ns, axis) for axis in self.xyz.T]
        return np.where((near <= GAP_S * 1e9)[:, None], np.stack(axes, axis=1), np.nan)


@dataclass(frozen=True, slots=True)
class Motion:
    """All poses and positions of some recordings, by frame and by robot and peer."""

    poses: Mapping[str, Poses] = field(default_factory=dict)
    estimates: Mapping[Names, Positions] = field(default_factory=dict)
    truths: Mapping[Names, Positions] = field(default_factory=dict)

    def space(self, robot: str) -> str:
        """The frame that a robot is shown in: the world, or its own where there is none."""
        own = horizontal_frame(robot)
        return WORLD if own in self.poses and self.poses[own].parent == WORLD else own

    def in_space(self, robot: str, points: Array, time_ns: Times) -> Array:
        """(N, 3) points of a robot's horizontal frame in the frame it is shown in."""
        if self.space(robot) != WORLD:
            return points
        return self.poses[horizontal_frame(robot)].applied(points, time_ns)


def read_motion(
    recordings: Mapping[Path, Summary], pairs: Iterable[Names], start_ns: int, end_ns: int
) -> Motion:
    """All that the recordings say of the pairs in [start_ns, end_ns), and their /tf."""
    pairs = list(pairs)
    found: dict[str, list[pa.RecordBatch]] = {}
    for path in recordings:
        for stretch in stretches(path, _fields(pairs), start_ns=start_ns, end_ns=end_ns):
            for topic, batch in stretch.items():
                found.setdefault(topic, []).append(batch)
    return _motion(found, pairs)


def glimpse(
    recordings: Mapping[Path, Summary], pairs: Iterable[Names], start_ns: int, end_ns: int
) -> Motion:
    """The same of a few moments: every frame and pair, and how far they go, without the wait."""
    pairs = list(pairs)
    found: dict[str, list[pa.RecordBatch]] = {}
    for path in recordings:
        seen = glance(path, _fields(pairs), start_ns=start_ns, end_ns=end_ns)
        for topic, batch in seen.items():
            found.setdefault(topic, []).append(batch)
    return _motion(found, pairs)


def _fields(pairs: Iterable[Names]) -> dict[str, Sequence[str] | None]:
    kinds = [kind(*pair) for pair in pairs for kind in (topics.position, topics.truth)]
    return {**dict.fromkeys(kinds), topics.TRANSFORMS: ("transforms",)}


def _motion(found: Mapping[str, list[pa.RecordBatch]], pairs: Iterable[Names]) -> Motion:
    held: dict[str, dict[Names, Positions]] = {"estimates": {}, "truths": {}}
    for pair in pairs:
        for kind, topic in (
            ("estimates", topics.position(*pair)),
            ("truths", topics.truth(*pair)),
        ):
            if topic in found:
                held[kind][pair] = _positions(pa.Table.from_batches(found[topic]))
    moved = found.get(topics.TRANSFORMS)
    return Motion(_poses(pa.Table.from_batches(moved)) if moved else {}, **held)


def _poses(table: pa.Table) -> dict[str, Poses]:
    column = table["transforms"].combine_chunks()
    rows = np.repeat(np.arange(len(column)), column.value_lengths().to_numpy())
    parts = column.flatten()
    time_ns = table["log_time"].to_numpy()[rows]
    xyz = vectors(parts.field("translation"), "xyz")
    xyzw = vectors(parts.field("rotation"), "xyzw")
    children = parts.field("child_frame_id").to_numpy(zero_copy_only=False)
    out = {}
    for frame in dict.fromkeys(children):
        own = np.flatnonzero(children == frame)
        own = own[np.argsort(time_ns[own], kind="stable")]
        parent = parts.field("parent_frame_id")[int(own[0])].as_py()
        out[frame] = Poses(parent, time_ns[own], xyz[own], xyzw[own])
    return out


def _positions(table: pa.Table) -> Positions:
    table = table.sort_by("log_time")
    xyz = np.stack([table[axis].to_numpy() for axis in "xyz"], axis=1)
    covariance = covariances(table["covariance"].combine_chunks())
    return Positions(table["log_time"].to_numpy(), xyz, covariance, table["status"].to_numpy())


def covariances(column: pa.ListArray) -> Array:
    """(N, 3, 3) of a list column; NaN where it is not given."""
    given = column.value_lengths().to_numpy() == 9
    out = np.full((len(column), 3, 3), np.nan)
    out[given] = column.filter(pa.array(given)).flatten().to_numpy().reshape(-1, 3, 3)
    return out


def vectors(column: pa.StructArray, axes: str) -> Array:
    """(N, k) of a column of structs with these fields."""
    return np.stack([column.field(axis).to_numpy() for axis in axes], axis=1)
