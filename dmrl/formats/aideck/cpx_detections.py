"""Detections as a CPX packet from the camera's chip to the drone's, for the onboard pilot."""

import struct
from collections.abc import Sequence

from dmrl.formats.aideck.cpx_log import APP, GAP8, ROUTE, STM32, Packet, pack_packet

MAGIC = 0xDE
HEAD = struct.Struct("<BBHI")
"""Magic, number of detections, number of the image, and its exposure on the camera's clock, ms."""
ROW = struct.Struct("<hhHH")
"""u and v in 1/16 px, depth in millimetres, and confidence of 65536."""
MOST = 20

Row = tuple[int, int, int, int]


def pack_detections(number: int, time_ms: int, rows: Sequence[Row]) -> bytes:
    """Return the packet of an image's detections, best first; those after `MOST` are left out."""
    kept = rows[:MOST]
    head = HEAD.pack(MAGIC, len(kept), number % (1 << 16), time_ms % (1 << 32))
    data = head + b"".join(ROW.pack(*row) for row in kept)
    return pack_packet(Packet(GAP8, STM32, APP, data))


def parse_detections(packet: bytes) -> tuple[int, int, list[Row]] | None:
    """Return number, time and detections of a packet's image; None: it holds something else."""
    if len(packet) < ROUTE.size + HEAD.size or packet[3] & 63 != APP:
        return None
    magic, count, number, time_ms = HEAD.unpack_from(packet, ROUTE.size)
    rows = packet[ROUTE.size + HEAD.size :]
    if magic != MAGIC or len(rows) != count * ROW.size:
        return None
    return number, time_ms, list(ROW.iter_unpack(rows))
