"""CPX packets of the AI-deck, decoded from a stream's bytes and encoded.

A packet is ``u16 length | u8 dst:3 src:3 last:1 | u8 function:6 version:2 | data``. Over TCP,
Bitcraze's firmware includes the two bytes of routing in the length; the nanocockpit firmware
does not.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

STM32, ESP32, HOST, GAP8 = 1, 2, 3, 4
APP, STREAMER = 5, 6

ROUTE = struct.Struct("<HBB")
PACKET_MAX_BYTES = 4094

# Routes from any chip to the host, with a defined function and version 0: few other bytes match.
PLAUSIBLE_ROUTE = re.compile(rb"[\x0b\x13\x23\x4b\x53\x63][\x01-\x06\x0e\x0f]")


@dataclass(frozen=True, slots=True)
class Packet:
    """One CPX packet: its source, destination, function and data."""

    source: int
    destination: int
    function: int
    data: bytes
    last: bool = True


class PacketReader:
    """Decoder of packets from a stream's bytes. It resynchronizes after other bytes.

    Attributes
    ----------
    skipped_bytes
        Number of bytes that belonged to no packet.
    """

    def __init__(self) -> None:
        self.skipped_bytes = 0
        self._buffer = bytearray()
        self._in_step = True
        self._streamer = False

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Yield the packets that these bytes complete."""
        self._buffer += data
        at = 0
        while (step := self._parse_at(at)) is not None:
            at, packet = step
            if packet is not None:
                yield packet
        del self._buffer[:at]

    def finish(self) -> bool:
        """End the stream; return whether a packet is incomplete. Its bytes count as skipped."""
        left = len(self._buffer)
        self._buffer.clear()
        self.skipped_bytes += left
        return left > 0

    def _parse_at(self, at: int) -> tuple[int, Packet | None] | None:
        """Return the offset after a step, with the packet at ``at`` if any; None: too few bytes."""
        size = self._parse_size(at)
        if size is None:
            return None
        end = at + ROUTE.size + size
        if size >= 0 and not self._in_step:
            # Four bytes may match a header by chance. Two headers at the right distance do not.
            after = self._parse_size(end)
            if after is None:
                return None
            size = size if after >= 0 else -1
        if size < 0:
            return self._skip_to_header(at)
        if len(self._buffer) < end:
            return None
        _, route, function = ROUTE.unpack_from(self._buffer, at)
        self._in_step = True
        self._streamer |= function == STREAMER
        data = bytes(self._buffer[at + ROUTE.size : end])
        return end, Packet(route >> 3 & 7, route & 7, function & 63, data, bool(route & 64))

    def _parse_size(self, at: int) -> int | None:
        """Return the data bytes behind a header; -1: no header, None: incomplete."""
        if len(self._buffer) < at + ROUTE.size:
            return None
        length, _, function = ROUTE.unpack_from(self._buffer, at)
        counted = 0 if self._streamer or function == STREAMER else 2
        plausible = (
            PLAUSIBLE_ROUTE.match(self._buffer, at + 2) and counted <= length <= PACKET_MAX_BYTES
        )
        return length - counted if plausible else -1

    def _skip_to_header(self, at: int) -> tuple[int, None]:
        found = PLAUSIBLE_ROUTE.search(self._buffer, at + 3)
        end = found.start() - 2 if found else len(self._buffer) - ROUTE.size + 1
        self._in_step = False
        self.skipped_bytes += end - at
        return end, None


def pack_packet(packet: Packet) -> bytes:
    """Encode a packet for TCP.

    Raises
    ------
    ValueError
        If its data is longer than a packet can hold.
    """
    counted = 0 if packet.function == STREAMER else 2
    length = len(packet.data) + counted
    if length > PACKET_MAX_BYTES:
        raise ValueError(
            f"packet of {length} bytes: at most {PACKET_MAX_BYTES} fit. Split the data"
        )
    route = packet.destination | packet.source << 3 | packet.last << 6
    return ROUTE.pack(length, route, packet.function) + packet.data
