"""Link to a Crazyflie that converts its log to samples."""

import math
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory
from typing import Any

from dmrl.errors import SettingError
from dmrl.formats.timestamps import Unwrapped
from dmrl.live.cflib_session import Session
from dmrl.live.log_blocks import Plan, Reading, plan
from dmrl.live.queue import Feed, Health, Received
from dmrl.live.receive_clocks import HostTime, SenderClock

MS = 1_000_000
TIMESTAMP_BITS = 24
SILENT_S = 5.0
"""Seconds without a log packet after which a link is assumed dead."""
FIRST_ANSWER_S, NEXT_ANSWER_S = 2.0, 5.0
"""Seconds without an answer after which the setup is aborted. The whole setup may take longer."""
RETRY_S = 1.0


@dataclass(slots=True)
class _Stream:
    """Packets of one block, to count losses."""

    period_ms: int
    last_ms: int | None = None

    def lost_before(self, time_ms: int) -> int:
        """Return the number of packets lost between the last one and this one."""
        last, self.last_ms = self.last_ms, time_ms
        return 0 if last is None else max(round((time_ms - last) / self.period_ms) - 1, 0)


@dataclass(slots=True)
class _Flight:
    """Packets of one connection and their conversion to samples.

    Each connection has a new one, since the drone and its clock may have restarted.
    """

    reading: Reading
    clock: SenderClock = field(default_factory=SenderClock)
    streams: dict[str, _Stream] = field(default_factory=dict)
    unwrapped: Unwrapped = field(default_factory=lambda: Unwrapped(TIMESTAMP_BITS))
    held: list[tuple[int, Mapping[str, float], int]] = field(default_factory=list)

    def take(
        self, block: str, timestamp: int, values: Mapping[str, float], arrival_ns: int
    ) -> Iterator[Received]:
        """Yield the samples whose times are known by now."""
        time_ms = self.unwrapped(timestamp)
        self.clock.hear(time_ms * MS, arrival_ns)
        self.held.append((time_ms, values, arrival_ns))
        if self.clock.settled:
            yield from self.rest()

    def rest(self) -> Iterator[Received]:
        """Yield the samples of all packets that wait for the clock."""
        held, self.held = self.held, []
        for time_ms, values, arrival_ns in held:
            for sample in self.reading.samples(self.clock.host_ns(time_ms * MS), values):
                yield Received(sample, arrival_ns)


class Link(threading.Thread):
    """Thread that receives one drone's log until stopped, and reconnects after each loss.

    It never sends a set-point, so a flying drone is not affected by this program.

    Parameters
    ----------
    robot
        Its name.
    uri
        Its address, in the form of cflib.
    peers
        See `plan_blocks`.
    period_ms
        See `plan_blocks`.
    feed
        Queue for the samples.
    now
        This computer's clock.
    """

    def __init__(
        self,
        robot: str,
        uri: str,
        peers: Mapping[int, str],
        period_ms: int,
        feed: Feed,
        now: HostTime,
    ) -> None:
        super().__init__(name=f"link {robot}", daemon=True)
        self.health = Health(robot)
        self.robot, self.uri = robot, uri
        self.reading: Reading | None = None
        self._peers, self._period_ms, self._feed, self._now = peers, period_ms, feed, now
        self._stop_wanted = threading.Event()
        self._flight: _Flight | None = None
        self._lock = threading.Lock()
        self._fault: Exception | None = None

    def stop(self) -> None:
        """Request the thread to end; `join` waits for it."""
        self._stop_wanted.set()

    def robot_time(self, robot_ms: float) -> int | None:
        """Convert a time of the drone's clock to this computer's; None while unknown.

        Parameters
        ----------
        robot_ms
            Milliseconds, with all bits or only those of the log's timestamps.
        """
        flight = self._flight
        # A clock that has not settled is still more accurate than the WiFi arrival of an image.
        if flight is None or not flight.clock.heard:
            return None
        whole_ms = math.floor(robot_ms)
        near_ms = flight.unwrapped.near(whole_ms) + (robot_ms - whole_ms)
        return flight.clock.host_ns(round(near_ms * MS))

    def run(self) -> None:
        """Connect and post samples, again after each loss, until stopped."""
        with TemporaryDirectory(prefix="dmrl-record-") as cache:
            while not self._stop_wanted.is_set():
                try:
                    self._connection(cache)
                except SettingError as e:
                    self.health.state = str(e)
                    self._feed.say(str(e))
                    return
                self._stop_wanted.wait(RETRY_S)

    def _connection(self, cache: str) -> None:
        session = Session(cache)
        try:
            why = self._set_up(session)
            if why is None:
                why = self._listen(session)
        finally:
            session.close()
            self._let_go()
        if self._stop_wanted.is_set() and self.health.connections:
            self.health.state = "stopped"
            return
        if self.health.state != why:
            self._feed.say(f"{self.robot}: {why} at {self.uri}; trying again")
        self.health.state = why

    def _set_up(self, session: Session) -> str | None:
        """Connect and start the blocks. Return the reason of a failure, or None."""
        session.open(self.uri)
        while not session.ready.wait(0.1):
            if session.lost or self._stop_wanted.is_set():
                return "nobody answers" if not session.last_packet_s else "lost while connecting"
            if session.silent_s() > (NEXT_ANSWER_S if session.last_packet_s else FIRST_ANSWER_S):
                return "nobody answers" if not session.last_packet_s else "stopped answering"
        wanted = plan(session.toc(), self._peers, self._period_ms, robot=self.robot)
        self._report_missing(wanted)
        flight = _Flight(Reading(self.robot, wanted))
        self._flight, self.reading = flight, flight.reading
        session.start(wanted, self._take)
        return None

    def _report_missing(self, wanted: Plan) -> None:
        missing = sorted(set(self._peers.values()) - set(wanted.peers.values()))
        if missing and not self.health.connections:
            self._feed.say(f"{self.robot} logs no distance to {', '.join(missing)}")

    def _listen(self, session: Session) -> str:
        """Wait for the end of the connection. Return the reason."""
        self.health.state = "connected"
        self.health.connections += 1
        self.health.last_arrival_ns = self._now()
        while not self._stop_wanted.wait(0.1):
            if self._fault is not None:
                fault, self._fault = self._fault, None
                return f"a packet could not be read ({fault!r})"
            if session.lost:
                return "lost"
            if session.refused:
                return f"refuses to log: {session.refused}"
            if self._now() - self.health.last_arrival_ns > SILENT_S * 1e9:
                return "silent"
        return "stopped"

    def _take(self, timestamp: int, values: Mapping[str, float], block: Any) -> None:
        """Process a packet in cflib's thread, which discards exceptions."""
        arrival_ns = self._now()
        try:
            self._take_at(arrival_ns, timestamp, values, block)
        except Exception as e:
            self._fault = e

    def _take_at(
        self, arrival_ns: int, timestamp: int, values: Mapping[str, float], block: Any
    ) -> None:
        with self._lock:
            flight = self._flight
            if flight is None:
                return
            self.health.received += 1
            self.health.last_arrival_ns = arrival_ns
            for received in flight.take(block.name, timestamp, values, arrival_ns):
                self._feed.put(received)
            stream = flight.streams.setdefault(block.name, _Stream(block.period_in_ms))
            self.health.lost += stream.lost_before(flight.unwrapped(timestamp))

    def _let_go(self) -> None:
        with self._lock:
            if self._flight is not None:
                for received in self._flight.rest():
                    self._feed.put(received)
            self._flight = None
