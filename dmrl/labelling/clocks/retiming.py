"""A recording's messages at the times that corrected clocks give them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.estimation.signals.clock_estimation import Clock
from dmrl.messages import message_class
from dmrl.recording import (
    LoadedRecording,
    RawMessage,
    RecordingWriter,
    parse_message,
    read_raw,
    shift_times,
)

MOCAP = "mocap"
"""Stands where a robot's name does."""
STAMPED = ("CompressedImage", "CameraCalibration", "PoseInFrame")

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Corrected:
    """How the times of a recording are corrected.

    Parameters
    ----------
    held
        The recording.
    clocks
        By robot, camera (``cf1/camera``) and ``mocap``.
    steady
        By topic of pictures: even times by those that they have.
    later_ns
        Added to all times.
    """

    held: LoadedRecording
    clocks: Mapping[str, Clock]
    steady: Mapping[str, Mapping[int, int]]
    later_ns: int = 0

    def earliest_ns(self) -> int:
        """Return the earliest corrected time, of the first messages of every robot."""
        found = []
        for topic in self.held.topics:
            if topic == topics.TRANSFORMS:  # whose they are stands inside
                raws = read_raw(self.held.path, topic)
                found += [self._of_transforms(raw).time_ns for raw in raws]
                continue
            times = self.held.get_times(topic)
            if len(times):
                first = int(min(self.steady.get(topic, {}).values(), default=times.min()))
                found.append(first + int(self._shift_ns(topic, np.array(first))))
        return min(found, default=0)

    def write(self, sink: RecordingWriter) -> None:
        """Copy the recording, corrected."""
        each = {topic: self._of_stamped for topic in self.held.topics if self._is_moved(topic)}
        each[topics.TRANSFORMS] = self._of_transforms
        shift_times(self.held.path, sink, self._shift_ns, each)

    def _is_moved(self, topic: str) -> bool:
        """Whether messages of a topic hold a time that changes."""
        moved = self.later_ns or topic in self.steady or self._clock_of(topic, _robot(topic))
        return bool(moved) and _is_stamped(self.held.topics[topic].schema)

    def _shift_ns(self, topic: str, time_ns: Times) -> Times:
        """Offset added to the times of a topic, by the robot in its name."""
        return self._lacking_ns(self._clock_of(topic, _robot(topic)), time_ns)

    def _lacking_ns(self, clock: Clock | None, time_ns: Times) -> Times:
        """Return the offsets of times to the reference's clock. As floats they are exact enough."""
        if clock is None:
            return np.full(time_ns.shape, self.later_ns)
        elapsed_s = (time_ns - self.held.start_ns) * 1e-9
        lacking_s = clock.offset_s + clock.drift * (elapsed_s - clock.at_s)
        return np.asarray(self.later_ns + np.rint(lacking_s * 1e9).astype(np.int64))

    def _clock_of(self, topic: str, robot: str) -> Clock | None:
        """Return the clock that corrects a message's times: of robot, camera or motion capture."""
        if topic.startswith(f"/{robot}/camera/") and f"{robot}/camera" in self.clocks:
            return self.clocks[f"{robot}/camera"]
        if MOCAP in self.clocks and (topic == topics.TRANSFORMS or topic.endswith("/truth")):
            return self.clocks[MOCAP]
        return self.clocks.get(robot)

    def _of_stamped(self, raw: RawMessage) -> RawMessage:
        """Correct a message that contains its time."""
        even_ns = self.steady.get(raw.topic, {}).get(raw.time_ns, raw.time_ns)
        shift_ns = int(self._shift_ns(raw.topic, np.array(even_ns)))
        return self._at(raw, even_ns + shift_ns, raw.publish_ns + shift_ns)

    def _of_transforms(self, raw: RawMessage) -> RawMessage:
        """Correct a message of transforms by the clock of the robot of its first frame."""
        robot = ""
        if _is_stamped(raw.schema_name):
            frames = parse_message(raw, message_class("FrameTransforms"), self.held.path).transforms
            robot = str(frames[0].child_frame_id.split("/")[0]) if frames else ""
        clock = self._clock_of(raw.topic, robot)
        shift_ns = int(self._lacking_ns(clock, np.array(raw.time_ns)))
        return self._at(raw, raw.time_ns + shift_ns, raw.publish_ns + shift_ns)

    def _at(self, raw: RawMessage, time_ns: int, publish_ns: int) -> RawMessage:
        """Return the message at another time; its own time, if it has one, is set as well."""
        data = raw.data
        if time_ns != raw.time_ns and _is_stamped(raw.schema_name):
            name = raw.schema_name.removeprefix("foxglove.")
            decoded = parse_message(raw, message_class(name), self.held.path)
            parts: list[Any] = decoded.transforms if name == "FrameTransforms" else [decoded]
            for part in parts:
                part.timestamp.seconds, part.timestamp.nanos = divmod(time_ns, 1_000_000_000)
            data = bytes(decoded.SerializeToString())
        return replace(raw, time_ns=time_ns, publish_ns=max(publish_ns, 0), data=data)


def _robot(topic: str) -> str:
    """Whose a topic is, by its name."""
    return topic.split("/")[1] if topic.count("/") > 1 else ""


def _is_stamped(schema: str) -> bool:
    """Whether messages of a type say of what time they are."""
    return schema.removeprefix("foxglove.") in (*STAMPED, "FrameTransforms")
