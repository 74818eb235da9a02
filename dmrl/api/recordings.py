"""A recording as an object: topics as tables, images, labels and detections."""

import os
import shutil
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import pyarrow as pa

from dmrl import topics
from dmrl.api import notebook_display
from dmrl.api.images import Images
from dmrl.api.topic import Topic, to_data_frame, to_log_time
from dmrl.errors import MissingTopic, SettingError
from dmrl.exchange.csv_parquet import flatten_table
from dmrl.recording import (
    Finding,
    Provenance,
    Stamped,
    TopicInfo,
    check,
    match_topics,
    read,
    read_summary,
)
from dmrl.storage import to_path

if TYPE_CHECKING:
    import pandas as pd

PathLike = str | os.PathLike[str]


class _TemporaryFolder:
    """A temporary folder that exists as long as this object."""

    def __init__(self, folder: Path) -> None:
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)


class Recording:
    """A recording, opened: its summary is read, its messages only when they are asked for.

    Parameters
    ----------
    path
        A whole .mcap file.
    temporary
        Folder that it lies in, which goes with this object and its topics. None: it stays.

    Raises
    ------
    RecordingError
        If it is absent, not a recording, cut short or damaged.
    """

    def __init__(self, path: PathLike, temporary: Path | None = None) -> None:
        self.path = to_path(path)
        self._summary = read_summary(self.path)
        self._kept = None if temporary is None else _TemporaryFolder(temporary)

    def __fspath__(self) -> str:
        return str(self.path)

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """Message type and number of messages, by topic."""
        return MappingProxyType(self._summary.topics)

    @property
    def robots(self) -> list[str]:
        """Names of the robots that have a topic here."""
        parts = (topics.parse_topic(row.pattern, t) for row in topics.TOPICS for t in self.topics)
        return sorted({found["robot"] for found in parts if found and "robot" in found})

    @property
    def start_ns(self) -> int:
        """First log time, nanoseconds."""
        return self._summary.start_ns

    @property
    def duration_s(self) -> float:
        """From the first log time to the last, seconds."""
        return (self._summary.end_ns - self._summary.start_ns) / 1e9

    @property
    def provenance(self) -> Provenance | None:
        """Provenance; None for a recording that dmrl did not write."""
        return self._summary.provenance

    def __getitem__(self, topic: str) -> Topic:
        """Return a topic.

        Raises
        ------
        MissingTopic
            If there is none of that name.
        """
        if topic not in self.topics:
            raise MissingTopic(topic, self.topics, self.path)
        return Topic(self.path, topic, self.topics[topic], self.start_ns, self._kept)

    def __contains__(self, topic: object) -> bool:
        return topic in self.topics

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __len__(self) -> int:
        """Return the number of topics."""
        return len(self.topics)

    def messages(
        self, *wanted: str, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[Stamped]:
        """Yield messages in log-time order, of topics or patterns such as ``/*/labels``.

        Raises
        ------
        MissingTopic
            If one of them matches nothing.
        """
        start_ns, end_ns = to_log_time(start_s, self.start_ns), to_log_time(end_s, self.start_ns)
        return read(self.path, *wanted, start_ns=start_ns, end_ns=end_ns)

    def images(
        self, robot: str | None = None, *, start_s: float | None = None, end_s: float | None = None
    ) -> Images:
        """Return a camera's images, decoded when they are used.

        Parameters
        ----------
        robot
            Robot that carries the camera. None: the only one with a camera.
        start_s, end_s
            Only images in [start_s, end_s), seconds from the start of the recording.

        Raises
        ------
        MissingTopic
            If there are no such images.
        SettingError
            If no robot is named and several have images.
        """
        filming = topics.list_robots(list(self.topics))
        if robot is None and len(filming) > 1:
            raise SettingError(f"{self.path} has images of {', '.join(filming)}. Name one of them")
        topic = topics.CAMERA_IMAGE(robot or (filming[0] if filming else "*"))
        match_topics(self.path, [topic])
        images = Images.load_topic(self.path, topic, self.start_ns, self._kept)
        return images.between(start_s, end_s)

    def labels(self, robot: str | None = None) -> "pd.DataFrame":
        """Return a row per labelled peer of an image: position, sigmas, status and source.

        Parameters
        ----------
        robot
            Robot of the images. None: all robots; see the column ``robot``.

        Raises
        ------
        MissingTopic
            If there are no labels.
        """
        return self._read_per_image(topics.LABELS, "peers", robot)

    def detections(self, robot: str | None = None) -> "pd.DataFrame":
        """Return a row per candidate: position, depth, confidence, and the network's threshold.

        Candidates below the threshold are in it too. The detections are
        ``found[found.confidence >= found.threshold]``.

        Raises
        ------
        MissingTopic
            If there are none.
        """
        return self._read_per_image(topics.DETECTIONS, "detections", robot)

    def _read_per_image(self, pattern: str, within: str, robot: str | None) -> "pd.DataFrame":
        found = sorted(match_topics(self.path, [topics.format_topic(pattern, robot=robot or "*")]))
        tables = []
        for topic in found:
            table = flatten_table(self[topic].to_arrow())
            names = [name.removeprefix(f"{within}.") for name in table.column_names]
            who = (topics.parse_topic(pattern, topic) or {})["robot"]
            column = pa.array([who] * len(table), pa.string())
            tables.append(table.rename_columns(names).append_column("robot", column))
        return to_data_frame(pa.concat_tables(tables).sort_by("log_time"), self.start_ns)

    def check(self) -> list[Finding]:
        """Return the findings of ``dmrl check``."""
        return list(check(self.path))

    def show(self, *, layout: str | None = None) -> object:
        """Show the recording in rerun: in a notebook's cell, or else in a window.

        Parameters
        ----------
        layout
            "image", "flight", "compare"; None: chosen by the topics.

        Raises
        ------
        MissingExtra
            If rerun is not installed.
        """
        return notebook_display.show_in_rerun([self.path], layout)

    def __repr__(self) -> str:
        count = self._summary.count
        return f"<{self.path}: {count} messages over {self.duration_s:.3f} s, {len(self)} topics>"

    def _repr_html_(self) -> str:
        rows = [(name, info.schema, info.count) for name, info in self.topics.items()]
        return notebook_display.html_table(repr(self)[1:-1], ("topic", "message", "messages"), rows)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.topics)


def open(path: PathLike) -> Recording:
    """Open a recording.

    Parameters
    ----------
    path
        A whole .mcap file.

    Raises
    ------
    RecordingError
        If it is absent, not a recording, cut short or damaged.

    Examples
    --------
    >>> import dmrl
    >>> flight = dmrl.open("flight.mcap")  # doctest: +SKIP
    >>> flight["/cf1/height"].to_pandas()["height_m"].plot()  # doctest: +SKIP
    """
    return Recording(path)
