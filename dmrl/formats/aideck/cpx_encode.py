"""Encoding of images as CPX packets, as the AI-deck sends them: the inverse of ``cpx``."""

from collections.abc import Iterator

from dmrl.formats.aideck import cpx
from dmrl.formats.aideck.cpx import Image, Layout
from dmrl.formats.aideck.cpx_log import APP, GAP8, HOST, STREAMER, Packet, pack_packet
from dmrl.formats.aideck.cpx_state import pack_state

UINT32 = 1 << 32
EMPTY_STATE = (0,) * 14


def pack_image(image: Image, layout: Layout = "plain") -> bytes:
    """Return all packets of an image, concatenated.

    Parameters
    ----------
    image
        "streamer" supports raw images only. Times, number and state are sent as far as the layout
        has fields for them.
    layout
        See ``cpx``.
    """
    if layout == "streamer":
        chunks, function = _iter_streamer_chunks(image), STREAMER
    else:
        chunks, function = _iter_app_chunks(image, layout), APP
    packets = (Packet(GAP8, HOST, function, chunk) for chunk in chunks)
    return b"".join(pack_packet(packet) for packet in packets)


def _iter_app_chunks(image: Image, layout: Layout) -> Iterator[bytes]:
    kind = cpx.ENCODINGS.index(image.encoding)
    size = image.width_px, image.height_px, 1, kind, len(image.data)
    header = cpx.HEADER.pack(cpx.MAGIC, *size)
    if layout == "stamped":
        state = pack_state(image.state) if image.state else EMPTY_STATE
        time_ms = (image.time_us or 0) // 1000
        header += cpx.STAMP.pack(time_ms % UINT32, *state[1:4], state[10] % UINT32)
    yield header
    # The firmware sends until a packet is not full, so full packets are followed by an empty one.
    for start in range(0, len(image.data) + 1, cpx.CHUNK_BYTES):
        yield image.data[start : start + cpx.CHUNK_BYTES]


def _iter_streamer_chunks(image: Image) -> Iterator[bytes]:
    received_us = image.state.received_us if image.state else 0
    state = pack_state(image.state) if image.state else EMPTY_STATE
    metadata = cpx.METADATA.pack(
        cpx.STREAMER_VERSION,
        image.width_px,
        image.height_px,
        1,
        0,
        (image.frame_id or 0) % 256,
        (image.time_us or 0) % UINT32,
        received_us % UINT32,
        *state,
        0,
        0,
        bytes(64),
        *(0, 0, 0, 0.0, 0.0, 0.0, 0.0),
    )
    data = metadata + image.data
    first = cpx.STREAMER_CHUNK_BYTES - cpx.BEGIN_HEADER.size
    begin = (cpx.STREAMER_BEGIN, cpx.STREAMER_IMAGE, len(data), cpx.compute_checksum(data))
    yield _pad_to_word(cpx.BEGIN_HEADER.pack(*begin) + data[:first])
    step = cpx.STREAMER_CHUNK_BYTES - cpx.DATA_HEADER.size
    for start in range(first, len(data), step):
        yield _pad_to_word(cpx.DATA_HEADER.pack(cpx.STREAMER_DATA) + data[start : start + step])


def _pad_to_word(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
