"""Simulated Crazyflie: the CRTP log protocol over UDP.

One CRTP packet per datagram, as cflib's ``udp://`` driver sends them: a header byte
``port:4 link:2 channel:2``, then at most 30 bytes. The server answers cflib's requests until it
is connected (link, platform, log, memories, parameters), and then sends log blocks.
"""

import errno
import socket
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from dmrl.errors import SettingError
from dmrl.live.log_blocks import BLOCK_BYTES, LOG_TYPES, MAX_BLOCKS
from dmrl.live.simulated.flight_source import FlightClock, SimulatedFaults, SimulatedFlight
from dmrl.live.threads import StoppableThread

PARAM, COMMANDER, MEMORY, LOG, GENERIC, PLATFORM, LINK = 2, 3, 4, 5, 7, 13, 15
PROTOCOL_VERSION = 10
FORMATS = dict(LOG_TYPES.values())
PARAMETERS = (
    ("firmware.revision0", 0x0A | 0x40, struct.pack("<I", 0x0D32A1)),
    ("stabilizer.estimator", 0x08, b"\x02"),
)
POLL_S = 0.05
Address = tuple[str, int]


@dataclass(slots=True)
class _ServedBlock:
    """A log block: (index of the variable, format in which it is sent) each, and its due time."""

    variables: list[tuple[int, str]] = field(default_factory=list)
    period_ms: int = 0
    due_ms: float = 0.0
    to: Address = ("", 0)

    @property
    def size(self) -> int:
        return struct.calcsize("<" + "".join(kind for _, kind in self.variables))


class SimulatedCrazyflie(StoppableThread):
    """Thread of one simulated drone.

    Parameters
    ----------
    robot
        Its name.
    address
        Host and port to listen at.
    flight
        Its measurements.
    clock
        Common clock of the flight.
    faults
        Simulated faults.
    seed
        Seed of the dropped packets.

    Raises
    ------
    SettingError
        If the port cannot be opened.
    """

    def __init__(
        self,
        robot: str,
        address: Address,
        flight: SimulatedFlight,
        clock: FlightClock,
        faults: SimulatedFaults,
        seed: int,
    ) -> None:
        super().__init__(f"fake {robot}")
        self.robot, self.sent, self.dropped, self.setpoints = robot, 0, 0, 0
        self._variables = list(flight.build_variables().items())
        self._clock, self._faults = clock, faults
        self._chance = np.random.default_rng(seed)
        self._blocks: dict[int, _ServedBlock] = {}
        self._rows = [_pack_toc_row(name, LOG_TYPES[v.kind][0]) for name, v in self._variables]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError as e:
            self._socket.close()
            host, port = address
            why = e.strerror or e
            raise SettingError(f"udp://{host}:{port}: {why}. Pass another --uri") from None

    @property
    def port(self) -> int:
        """Port at which it listens."""
        return int(self._socket.getsockname()[1])

    @property
    def is_logging(self) -> bool:
        """Whether any of its blocks is started."""
        return any(block.period_ms for block in list(self._blocks.values()))

    def close(self) -> None:
        """Release the port, if the thread was never started."""
        if self.ident is None:
            self._socket.close()

    def run(self) -> None:
        """Serve requests and send log blocks, until stopped."""
        with self._socket:
            while not self._stop_wanted.is_set():
                now_s = self._clock.now_s()
                dead = self._faults.is_dead(now_s)
                if dead:
                    self._blocks.clear()
                self._socket.settimeout(self._next_due_s(now_s))
                with suppress(TimeoutError, ConnectionError):  # the latter: a client is gone
                    packet, sender = self._socket.recvfrom(64)
                    if packet and not dead:
                        self._answer_packet(packet, sender)
                if not dead:
                    self._send_due_blocks()

    def _next_due_s(self, now_s: float) -> float:
        running = [block.due_ms for block in self._blocks.values() if block.period_ms]
        if not running:
            return POLL_S
        due_s = self._faults.time_at_clock(min(running), now_s)
        return min(max((due_s - now_s) / self._clock.speed, 1e-4), POLL_S)

    def _send_due_blocks(self) -> None:
        now_s = self._clock.now_s()
        shown_ms = self._faults.clock_ms(now_s)
        for number, block in list(self._blocks.items()):
            while block.period_ms and block.due_ms <= shown_ms and now_s < self._clock.end_s:
                self._send_block(number, block, self._faults.time_at_clock(block.due_ms, now_s))
                block.due_ms += block.period_ms

    def _send_block(self, number: int, block: _ServedBlock, time_s: float) -> None:
        if self._chance.random() < self._faults.drop:
            self.dropped += 1
            return
        stamp = struct.pack("<I", int(block.due_ms) % (1 << 24))[:3]
        values = b"".join(
            struct.pack("<" + kind, _to_packable(kind, self._variables[index][1].value_at(time_s)))
            for index, kind in block.variables
        )
        self._send_packet(LOG, 2, bytes([number]) + stamp + values, block.to)
        self.sent += 1

    def _send_packet(self, port: int, channel: int, data: bytes, to: Address) -> None:
        with suppress(ConnectionError):  # the client may be gone
            self._socket.sendto(bytes([port << 4 | 3 << 2 | channel]) + data, to)

    def _answer_packet(self, packet: bytes, sender: Address) -> None:
        """Send the firmware's answer, if it has one."""
        port, channel, data = packet[0] >> 4, packet[0] & 3, packet[1:]
        reply = self._build_reply(port, channel, data, sender)
        if reply is not None:
            self._send_packet(port, channel, reply, sender)

    def _build_reply(self, port: int, channel: int, data: bytes, sender: Address) -> bytes | None:
        if port == LINK:
            return data if channel in (0, 3) else b"Bitcraze Crazyflie\0"
        if port == LOG:
            return self._build_log_reply(channel, data, sender)
        if port == PARAM:
            return _answer_parameter(channel, data)
        question = port, channel, data[:1]
        if question == (PLATFORM, 1, b"\0"):
            return bytes([0, PROTOCOL_VERSION])
        if question == (MEMORY, 0, b"\1"):  # how many memories: none
            return b"\1\0"
        self.setpoints += port in (COMMANDER, GENERIC)
        return None

    def _build_log_reply(self, channel: int, data: bytes, sender: Address) -> bytes | None:
        if channel == 0:
            return _answer_toc(data, self._rows, zlib.crc32(b"".join(self._rows)))
        return self._run_log_command(data, sender) if channel == 1 and data else None

    def _run_log_command(self, data: bytes, sender: Address) -> bytes:
        """Execute a log command; return command, block, error number."""
        command, number = data[0], data[1] if len(data) > 1 else 0
        if command == 5:  # reset
            self._blocks.clear()
        elif command in (6, 7):  # create, append
            return bytes([command, number, self._create_block(command == 6, number, data[2:])])
        elif number not in self._blocks:
            return bytes([command, number, errno.ENOENT])
        elif command == 2:  # delete
            del self._blocks[number]
        elif command in (3, 4):  # start, stop
            self._start_block(self._blocks[number], 10 * data[2] if command == 3 else 0, sender)
        return bytes([command, number, 0])

    def _create_block(self, new: bool, number: int, data: bytes) -> int:
        if new and number in self._blocks:
            return errno.EEXIST
        if new and len(self._blocks) >= MAX_BLOCKS:
            return errno.ENOMEM
        block = _ServedBlock() if new else self._blocks[number]
        for kind, index in struct.iter_unpack("<BH", data[: len(data) // 3 * 3]):
            if index >= len(self._variables) or kind & 15 not in FORMATS:
                return errno.ENOENT
            block.variables.append((index, FORMATS[kind & 15]))
        if block.size > BLOCK_BYTES:
            return errno.E2BIG
        self._blocks[number] = block
        return 0

    def _start_block(self, block: _ServedBlock, period_ms: int, sender: Address) -> None:
        if period_ms:
            self._clock.take_off()
        shown_ms = self._faults.clock_ms(self._clock.now_s())
        block.due_ms = float(np.ceil(shown_ms / max(period_ms, 1)) * period_ms)
        block.period_ms, block.to = period_ms, sender


def _to_packable(kind: str, value: float) -> float | int:
    return value if kind in "fe" else round(value)


def _pack_toc_row(name: str, kind: int) -> bytes:
    return bytes([kind]) + name.replace(".", "\0").encode() + b"\0"


def _answer_toc(data: bytes, rows: list[bytes], crc: int) -> bytes | None:
    """Return the answer to a request for a table of contents, version 2."""
    if data[:1] == b"\3":
        return struct.pack("<BHIBB", 3, len(rows), crc, MAX_BLOCKS, 128)
    if data[:1] == b"\2" and len(data) >= 3:
        index = struct.unpack_from("<H", data, 1)[0]
        return data[:3] + rows[index] if index < len(rows) else data[:3]
    return None


def _answer_parameter(channel: int, data: bytes) -> bytes | None:
    if channel == 0:
        rows = [_pack_toc_row(name, kind) for name, kind, _ in PARAMETERS]
        return _answer_toc(data, rows, zlib.crc32(b"".join(rows)))
    if channel in (1, 2) and len(data) >= 2:
        index = struct.unpack_from("<H", data)[0]
        if index >= len(PARAMETERS):
            return data[:2] + bytes([errno.ENOENT])
        return data[:2] + b"\0" + PARAMETERS[index][2] if channel == 1 else data
    return None
