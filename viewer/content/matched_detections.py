"""Match the rows of a dataset with detections from the recordings of ``dmrl predict``."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.evaluation.detections import build_points
from dmrl.geometry.frames import Array, is_inside
from dmrl.learn.inference.matching import compute_errors
from dmrl.recording import Provenance, iter_topic_batches, read_summary

RowKey = tuple[str, str, int]
"""Source recording of a row, robot, log time in nanoseconds."""


@dataclass(frozen=True, slots=True)
class MatchedDetections:
    """Detections of a model for the rows of a dataset.

    Parameters
    ----------
    messages
        All Detections.
    place
        (N,) index of each row's message; -1: none.
    where
        (N,) recording, robot and log time of the message; None: none.
    """

    messages: pa.Table
    place: NDArray[np.int64]
    where: tuple[tuple[Path, str, int] | None, ...]

    def select_rows(self, rows: NDArray[np.int64]) -> "MatchedDetections":
        """Select some of the rows."""
        return MatchedDetections(
            self.messages, self.place[rows], tuple(self.where[k] for k in rows)
        )

    def to_detections(self) -> pa.RecordBatch:
        """Return the columns of Detections, with an empty list for rows without a message."""
        empty = self.messages.slice(0, 1).to_pylist()[0] | {"detections": []}
        blank = pa.Table.from_pylist([empty], self.messages.schema)
        every = pa.concat_tables([self.messages, blank])
        (batch,) = every.take(self.place % len(every)).combine_chunks().to_batches()
        return batch

    def iter_maps(self) -> Iterator[tuple[int, pa.RecordBatch]]:
        """Yield the number of each row that has a map, and the columns of its GridMap."""
        rows: dict[tuple[Path, str], dict[int, list[int]]] = {}
        for row, where in enumerate(self.where):
            if where is not None:
                rows.setdefault(where[:2], {}).setdefault(where[2], []).append(row)
        for (path, robot), at in rows.items():
            for time_ns, columns in _iter_maps(path, robot, list(at)):
                yield from ((row, columns) for row in at[time_ns])

    def load_maps(self) -> pa.RecordBatch | None:
        """Read the columns of GridMap; None unless every row has one."""
        if any(where is None for where in self.where):
            return None
        held = dict(self.iter_maps())
        if len(held) < len(self.where):
            return None
        rows = pa.Table.from_batches([held[row] for row in range(len(self.where))])
        (batch,) = rows.combine_chunks().to_batches()
        return batch


def _iter_maps(
    path: Path, robot: str, wanted_ns: Sequence[int]
) -> Iterator[tuple[int, pa.RecordBatch]]:
    """Yield the log time and the row of a robot's GridMaps at some log times."""
    topic = topics.GRID(robot)
    span = {"start_ns": min(wanted_ns), "end_ns": max(wanted_ns) + 1}
    for stretch in iter_topic_batches(path, {topic: None}, **span):
        times_ns = stretch[topic]["log_time"].to_numpy()
        for row in np.flatnonzero(np.isin(times_ns, wanted_ns)).tolist():
            yield int(times_ns[row]), stretch[topic].slice(row, 1)


def find_detections(
    recordings: Sequence[Path], folder: Path, wanted: Sequence[RowKey]
) -> MatchedDetections:
    """Find the detections of the images of a dataset.

    Parameters
    ----------
    recordings
        Recordings with detections.
    folder
        The dataset.
    wanted
        Key of each of its rows.

    Raises
    ------
    RecordingError
        If a recording has no detections, or none of these images.
    """
    sources = {source for source, _, _ in wanted}
    parts: list[pa.RecordBatch] = []
    where: list[tuple[Path, str, int]] = []  # one for each row of the parts
    at: dict[RowKey, int] = {}
    for path in recordings:
        names, robots = _match_sources(path, folder, sources)
        for robot, batch in _iter_detections(path, robots):
            for time_ns in batch["log_time"].to_pylist():
                # The source of a row is this recording, or one that it was made from.
                at |= {(name, robot, time_ns): len(where) for name in names}
                where.append((path, robot, time_ns))
            parts.append(batch)
    place = np.array([at.get(key, -1) for key in wanted], np.int64)
    if not (place >= 0).any():
        raise RecordingError(f"no image of {folder} is in {recordings[0]}. Predict on its images")
    found = tuple(where[k] if k >= 0 else None for k in place.tolist())
    return MatchedDetections(pa.Table.from_batches(parts), place, found)


def _iter_detections(path: Path, robots: Sequence[str]) -> Iterator[tuple[str, pa.RecordBatch]]:
    """Yield the robot and the columns of its detections, batch by batch."""
    own = {topics.DETECTIONS(robot): robot for robot in robots}
    for stretch in iter_topic_batches(path, dict.fromkeys(own)):
        for topic, batch in stretch.items():
            yield own[topic], batch


def _match_sources(path: Path, folder: Path, sources: set[str]) -> tuple[set[str], list[str]]:
    """Return the dataset's sources among a recording and its inputs, and robots with detections."""
    kept = read_summary(path)
    robots = topics.list_robots(list(kept.topics), topics.DETECTIONS)
    if not robots:
        raise RecordingError(f"{path} has no detections. Try: dmrl predict MODEL {path} OUT.mcap")
    names = {path.name, *_collect_ancestors(kept.provenance)} & sources
    if not names:
        raise RecordingError(
            f"{folder} was not made from {path} or its inputs. "
            "Predict on the dataset's own recordings"
        )
    return names, robots


def _collect_ancestors(made: Provenance | None) -> set[str]:
    """Return the names of all files that a recording was made from."""
    if made is None:
        return set()
    return {i.name for i in made.inputs} | {
        n for i in made.inputs for n in _collect_ancestors(i.provenance)
    }


def compute_row_errors(
    rows: pa.Table, found: MatchedDetections, size_px: tuple[int, int]
) -> tuple[Array, Array]:
    """Compute the errors of each row's worst label, pixels and metres of depth; NaN if unknown."""
    peers = rows["peers"].combine_chunks()
    every = np.arange(len(peers))
    labels = build_points(peers, None, every, every)
    uv = np.stack([labels.u_px, labels.v_px], axis=1)
    labels = labels.select(is_inside(uv, *size_px) & ~(labels.depth_m <= 0))
    messages = found.messages["detections"].combine_chunks()
    (known,) = np.nonzero(found.place >= 0)
    mine = messages.take(pa.array(found.place[known]))
    detections = build_points(mine, None, np.arange(len(mine)), known)
    judged = np.isin(labels.image, known)
    labels = labels.select(judged)
    off = compute_errors(labels, detections)
    depth_error_m = np.where(np.isnan(labels.depth_m), -1.0, abs(off.depth_m))
    return (
        _largest_per_image(len(peers), labels.image, off.norm_px),
        _largest_per_image(len(peers), labels.image, depth_error_m),
    )


def _largest_per_image(count: int, image: NDArray[np.int64], values: Array) -> Array:
    out = np.full(count, -1.0)
    np.maximum.at(out, image, np.nan_to_num(values, nan=np.inf))
    return np.where(out < 0, np.nan, out)
