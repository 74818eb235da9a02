"""Packets are found in a stream of bytes, also between noise."""

import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dmrl.formats.aideck import cpx
from dmrl.formats.aideck.cpx import ImageReader
from dmrl.formats.aideck.cpx_log import (
    APP,
    GAP8,
    HOST,
    PACKET_MAX_BYTES,
    STREAMER,
    Packet,
    PacketReader,
    pack_packet,
)


@pytest.mark.parametrize(("function", "counted"), [(APP, 2), (STREAMER, 0)])
def test_packet_length_is_limited(function: int, counted: int) -> None:
    most = PACKET_MAX_BYTES - counted
    packet = Packet(GAP8, HOST, function, bytes(most), last=False)
    data = pack_packet(packet)
    assert struct.unpack_from("<HBB", data) == (PACKET_MAX_BYTES, 3 | 4 << 3, function)
    follower = pack_packet(Packet(GAP8, HOST, function, b"x"))
    assert next(PacketReader().feed(data + follower)) == packet
    with pytest.raises(ValueError, match=f"packet of {PACKET_MAX_BYTES + 1} bytes"):
        pack_packet(Packet(GAP8, HOST, function, bytes(most + 1)))


def test_bytes_between_packets_are_counted_and_the_rest_at_the_end() -> None:
    packet = pack_packet(Packet(GAP8, HOST, APP, b"abc"))
    reader = PacketReader()
    got = list(reader.feed(packet + b"\0" * 7 + packet * 2))
    assert (len(got), reader.skipped_bytes) == (3, 7)
    assert list(reader.feed(packet[:-1])) == []
    assert reader.finish() and reader.skipped_bytes == 7 + len(packet) - 1
    assert not reader.finish()


def pack_app_packet(data: bytes) -> bytes:
    """Return a packet from the GAP8 to the host with the function for applications."""
    return pack_packet(Packet(GAP8, HOST, APP, data))


@pytest.mark.parametrize(
    ("header", "broken"),
    [
        ((10, 10, 1, 0, 100), 0),
        ((10, 10, 1, 2, 100), 1),  # unknown encoding
        ((0, 10, 1, 0, 0), 1),
        ((10, 0, 1, 0, 0), 1),
        ((10, 10, 1, 1, 0), 1),
        ((10, 10, 1, 1, 1 << 22), 0),
        ((10, 10, 1, 1, (1 << 22) + 1), 1),
    ],
)
def test_header_limits_are_checked(header: tuple[int, ...], broken: int) -> None:
    reader = ImageReader()
    list(reader.feed(pack_app_packet(cpx.HEADER.pack(cpx.MAGIC, *header))))
    assert reader.broken == broken


def find_packets_bytewise(data: bytes) -> tuple[list[bytes], int]:
    """Search for packets byte by byte; return their payloads and the number of other bytes."""

    streamer = False

    def read_size(at: int) -> int | None:
        """Return the payload size of the header at a byte, -1 for none, None if it is cut."""
        if at + 4 > len(data):
            return None
        length, route, function = struct.unpack_from("<HBB", data, at)
        to, of, last = route & 7, route >> 3 & 7, route >> 6
        known = (
            to == 3
            and (of, last) in {(k, last) for k in (1, 2, 4) for last in (0, 1)}
            and function in (*range(1, 7), 14, 15)
        )
        counted = 0 if streamer or function == 6 else 2
        return length - counted if known and counted <= length <= 4094 else -1

    found, at, skipped, in_step = [], 0, 0, True
    while (here := read_size(at)) is not None:
        if here >= 0 and not in_step:
            after = read_size(at + 4 + here)
            if after is None:
                break
            here = here if after >= 0 else -1
        if here < 0:
            at, skipped, in_step = at + 1, skipped + 1, False
            continue
        if at + 4 + here > len(data):
            break
        found.append(data[at + 4 : at + 4 + here])
        streamer |= data[at + 3] == 6
        at, in_step = at + 4 + here, True
    return found, skipped + len(data) - at


NOISE = st.sampled_from([b"", bytes(3), b"\0\0\x63\5", b"\2\0\x63", b"\6\0\x63\5\0", b"\x0b\1"])


@example([(b"\2\0\x63", 4)], 1)  # noise and a length that look like a header together
@given(st.lists(st.tuples(NOISE, st.integers(0, 5)), max_size=9), st.integers(1, 9))
@pytest.mark.heavy
def test_packets_in_noise_equal_a_bytewise_search(
    parts: list[tuple[bytes, int]], step: int
) -> None:
    data = b"".join(noise + pack_app_packet(bytes(range(size))) for noise, size in parts)
    reader = PacketReader()
    pieces = [data[k : k + step] for k in range(0, len(data), step)]
    got = [packet.data for piece in pieces for packet in reader.feed(piece)]
    reader.finish()
    assert (got, reader.skipped_bytes) == find_packets_bytewise(data)
