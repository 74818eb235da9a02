"""What comes in from robots, on its way to whoever writes or shows it."""

from dataclasses import dataclass
from queue import Empty, SimpleQueue

from dmrl.samples.sample import Sample


@dataclass(frozen=True, slots=True)
class Received:
    """A sample and when it arrived on this computer, nanoseconds since 1970."""

    sample: Sample
    arrival_ns: int


@dataclass(slots=True)
class Health:
    """How one link or camera is doing. Written by its thread, read by others.

    Parameters
    ----------
    source
        Robot, and "camera" for its camera.
    state
        In a word or a line: what it is doing now.
    received
        Packets or images so far.
    lost
        That were sent and never came, as far as it can be told.
    broken
        That came and cannot be used.
    connections
        How often it was connected.
    """

    source: str
    state: str = "connecting"
    received: int = 0
    lost: int = 0
    broken: int = 0
    connections: int = 0
    last_arrival_ns: int = 0
    detail: str = ""


class Feed:
    """A queue from many threads to one."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Received | str] = SimpleQueue()

    def put(self, received: Received) -> None:
        """Hand on a sample."""
        self._queue.put(received)

    def say(self, line: str) -> None:
        """Hand on a line of news for the user."""
        self._queue.put(line)

    def take(self, timeout_s: float) -> list[Received | str]:
        """All that is there; waits for the first at most so long."""
        taken: list[Received | str] = []
        try:
            taken.append(self._queue.get(timeout=timeout_s))
            while len(taken) < 1000:
                taken.append(self._queue.get_nowait())
        except Empty:
            pass
        return taken
