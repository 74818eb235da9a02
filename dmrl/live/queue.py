"""Queue of received samples, and status of the links that fill it."""

from dataclasses import dataclass
from queue import Empty, SimpleQueue

from dmrl.samples.sample import Sample


@dataclass(frozen=True, slots=True)
class ReceivedSample:
    """A sample and its time of arrival on this computer, nanoseconds since 1970."""

    sample: Sample
    arrival_ns: int


@dataclass(slots=True)
class LinkStatus:
    """Status of one link or camera. Written by its thread, read by others.

    Parameters
    ----------
    source
        Robot, and "camera" for its camera.
    state
        Current activity, in a word or a line.
    received
        Packets or images so far.
    lost
        Packets or images that were sent and never arrived, as far as it can be detected.
    broken
        Packets or images that cannot be used.
    connections
        Number of connections so far.
    """

    source: str
    state: str = "connecting"
    received: int = 0
    lost: int = 0
    broken: int = 0
    connections: int = 0
    last_arrival_ns: int = 0


class SampleQueue:
    """Queue from many threads to one."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[ReceivedSample | str] = SimpleQueue()

    def post_sample(self, received: ReceivedSample) -> None:
        """Post a sample."""
        self._queue.put(received)

    def post_message(self, line: str) -> None:
        """Post a message for the user."""
        self._queue.put(line)

    def get_batch(self, timeout_s: float) -> list[ReceivedSample | str]:
        """Return all queued items; wait for the first at most ``timeout_s``."""
        taken: list[ReceivedSample | str] = []
        try:
            taken.append(self._queue.get(timeout=timeout_s))
            while len(taken) < 1000:
                taken.append(self._queue.get_nowait())
        except Empty:
            pass
        return taken
