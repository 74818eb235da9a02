"""Link to a Crazyflie that converts its log to samples."""

import math
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory
from typing import Any

from dmrl.errors import SettingError
from dmrl.formats.clocks import CounterUnwrapper
from dmrl.live.cflib_session import CflibSession
from dmrl.live.log_blocks import DISTANCE_VARIABLE, LogDecoder, LogPlan, plan_blocks
from dmrl.live.queue import LinkStatus, ReceivedSample, SampleQueue
from dmrl.live.receive_clocks import HostClock, SenderClock
from dmrl.live.threads import StoppableThread

NS_PER_MS = 1_000_000
TIMESTAMP_BITS = 24
RECEIVE_TIMEOUT_S = 5.0
"""Seconds without a log packet after which a link is assumed dead."""
FIRST_ANSWER_TIMEOUT_S, NEXT_ANSWER_TIMEOUT_S = 2.0, 5.0
"""Seconds without an answer after which the setup is aborted. The whole setup may take longer."""
MAX_SILENCE_S = 1.0
"""Seconds without a log packet after which the drone may have restarted."""
RETRY_DELAY_S = 1.0
MAX_DELAY_MS = 2_000
"""Largest difference between two packets' delays. A larger one is a restart of the drone."""


class PacketCount:
    """Count of lost packets by the drone's own clock, over pauses and reconnections.

    A drone that restarted begins at another time; nothing is known of its packets before that.
    """

    def __init__(self) -> None:
        self._last_ms: dict[str, int] = {}
        self._seen_ms: dict[str, int] = {}

    def add_packet(self, block: str, period_ms: int, timestamp: int, arrival_ns: int) -> int:
        """Count a packet; return the number lost since the one before of its block.

        Parameters
        ----------
        block
            Name of the block.
        period_ms
            Its period.
        timestamp
            Time of the packet on the drone's clock, milliseconds, 24 bits.
        arrival_ns
            Time of arrival on this computer's clock.
        """
        arrival_ms = arrival_ns // NS_PER_MS
        last_ms, seen_ms = self._last_ms.get(block), self._seen_ms.get(block, 0)
        self._last_ms[block], self._seen_ms[block] = timestamp, arrival_ms
        if last_ms is None:
            return 0
        step_ms = (timestamp - last_ms) % (1 << TIMESTAMP_BITS)
        waited_ms = arrival_ms - seen_ms
        whole = round((waited_ms - step_ms) / (1 << TIMESTAMP_BITS)) << TIMESTAMP_BITS
        if abs(step_ms + whole - waited_ms) > MAX_DELAY_MS:
            return 0
        return max(round((step_ms + whole) / period_ms) - 1, 0)


@dataclass(slots=True)
class _LinkConnection:
    """Packets of one connection and their conversion to samples.

    Each connection has a new one, since the drone and its clock may have restarted.
    """

    reading: LogDecoder
    clock: SenderClock = field(default_factory=SenderClock)
    unwrapped: CounterUnwrapper = field(default_factory=lambda: CounterUnwrapper(TIMESTAMP_BITS))
    held: list[tuple[int, Mapping[str, float], int]] = field(default_factory=list)

    def add_packet(
        self, block: str, timestamp: int, values: Mapping[str, float], arrival_ns: int
    ) -> Iterator[ReceivedSample]:
        """Yield the samples whose times are known by now."""
        time_ms = self.unwrapped(timestamp)
        self.clock.add_sample(time_ms * NS_PER_MS, arrival_ns)
        self.held.append((time_ms, values, arrival_ns))
        if self.clock.settled:
            yield from self.flush()

    def flush(self) -> Iterator[ReceivedSample]:
        """Yield the samples of all packets that wait for the clock."""
        held, self.held = self.held, []
        for time_ms, values, arrival_ns in held:
            for sample in self.reading.iter_samples(
                self.clock.to_host_ns(time_ms * NS_PER_MS), values
            ):
                yield ReceivedSample(sample, arrival_ns)


class CrazyflieLink(StoppableThread):
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
        feed: SampleQueue,
        now: HostClock,
    ) -> None:
        super().__init__(f"link {robot}")
        self.health = LinkStatus(robot)
        self.robot, self.uri = robot, uri
        self.reading: LogDecoder | None = None
        self._peers, self._period_ms, self._feed, self._now = peers, period_ms, feed, now
        self._flight: _LinkConnection | None = None
        self._packets = PacketCount()
        self._lock = threading.Lock()
        self._fault: Exception | None = None

    def to_host_time_ns(self, robot_ms: float) -> int | None:
        """Convert a time of the drone's clock to this computer's; None while unknown.

        Parameters
        ----------
        robot_ms
            Milliseconds, of the present, with all bits or only those of the log's timestamps.
        """
        flight = self._flight
        # A clock that has not settled is still more accurate than the WiFi arrival of an image.
        if flight is None or not flight.clock.has_samples:
            return None
        whole_ms = math.floor(robot_ms)
        near_ms = flight.unwrapped.find_nearest(whole_ms) + (robot_ms - whole_ms)
        host_ns, now_ns = flight.clock.to_host_ns(round(near_ms * NS_PER_MS)), self._now()
        # After a restart of the drone, its camera may be back before its log.
        silent = now_ns - self.health.last_arrival_ns > MAX_SILENCE_S * 1e9
        return None if silent and abs(now_ns - host_ns) > MAX_DELAY_MS * NS_PER_MS else host_ns

    def run(self) -> None:
        """Connect and post samples, again after each loss, until stopped."""
        with TemporaryDirectory(prefix="dmrl-record-") as cache:
            while not self._stop_wanted.is_set():
                try:
                    self._run_connection(cache)
                except SettingError as e:
                    self.health.state = str(e)
                    self._feed.post_message(str(e))
                    return
                self._stop_wanted.wait(RETRY_DELAY_S)

    def _run_connection(self, cache: str) -> None:
        session = CflibSession(cache)
        try:
            why = self._start_session(session)
            if why is None:
                why = self._wait_for_end(session)
        finally:
            session.close()
            self._flush_connection()
        if self._stop_wanted.is_set() and self.health.connections:
            self.health.state = "stopped"
            return
        if self.health.state != why:
            self._feed.post_message(f"{self.robot}: {why} at {self.uri}; trying again")
        self.health.state = why

    def _start_session(self, session: CflibSession) -> str | None:
        """Connect and start the blocks. Return the reason of a failure, or None."""
        session.open(self.uri)
        while not session.ready.wait(0.1):
            if session.lost or self._stop_wanted.is_set():
                return "nobody answers" if not session.last_packet_s else "lost while connecting"
            if session.idle_time_s() > (
                NEXT_ANSWER_TIMEOUT_S if session.last_packet_s else FIRST_ANSWER_TIMEOUT_S
            ):
                return "nobody answers" if not session.last_packet_s else "stopped answering"
        toc = session.list_variables()
        wanted = plan_blocks(toc, self._peers, self._period_ms, robot=self.robot)
        self._report_missing(toc, wanted)
        flight = _LinkConnection(LogDecoder(self.robot, wanted))
        self._flight, self.reading = flight, flight.reading
        session.start_blocks(wanted, self._on_packet)
        return None

    def _report_missing(self, toc: Mapping[str, str], wanted: LogPlan) -> None:
        """Report peers without a distance, or distances without a peer, once."""
        if self.health.connections:
            return
        if missing := sorted(set(self._peers.values()) - set(wanted.peers.values())):
            self._feed.post_message(f"{self.robot} logs no distance to {', '.join(missing)}")
        unnamed = sorted(name for name in toc if name.startswith(DISTANCE_VARIABLE))
        if unnamed and not self._peers:
            self._feed.post_message(
                f"{self.robot}: {', '.join(unnamed)} not recorded, since the robots at the other "
                "end are unknown. Pass: --peer N=NAME"
            )

    def _wait_for_end(self, session: CflibSession) -> str:
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
            if self._now() - self.health.last_arrival_ns > RECEIVE_TIMEOUT_S * 1e9:
                return "silent"
        return "stopped"

    def _on_packet(self, timestamp: int, values: Mapping[str, float], block: Any) -> None:
        """Process a packet in cflib's thread, which discards exceptions."""
        arrival_ns = self._now()
        try:
            self._process_packet(arrival_ns, timestamp, values, block)
        except Exception as e:
            self._fault = e

    def _process_packet(
        self, arrival_ns: int, timestamp: int, values: Mapping[str, float], block: Any
    ) -> None:
        with self._lock:
            flight = self._flight
            if flight is None:
                return
            self.health.received += 1
            self.health.last_arrival_ns = arrival_ns
            for received in flight.add_packet(block.name, timestamp, values, arrival_ns):
                self._feed.post_sample(received)
            self.health.lost += self._packets.add_packet(
                block.name, block.period_in_ms, timestamp, arrival_ns
            )

    def _flush_connection(self) -> None:
        with self._lock:
            if self._flight is not None:
                for received in self._flight.flush():
                    self._feed.post_sample(received)
            self._flight = None
