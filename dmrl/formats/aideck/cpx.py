"""Images of the AI-deck's stream, decoded from CPX packets.

Three layouts of images are supported:

* ``plain``     an 11-byte header (size, kind), then chunks, without a time;
* ``stamped``   25 bytes: adds the camera's time in ms and the robot's position;
* ``streamer``  nanocockpit's: 148 bytes of metadata before the pixels, with the frame's number
  (uint8), its time in us (uint32, wraps in 71.6 min) and the robot's last state.

This module opens no socket and no file: it converts bytes to images.
"""

import binascii
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

from dmrl.formats.aideck.cpx_log import APP, STREAMER, Packet, PacketReader
from dmrl.formats.aideck.cpx_state import STATE_FORMAT, RobotState, unpack_state
from dmrl.formats.clocks import CounterUnwrapper

Layout = Literal["plain", "stamped", "streamer"]
Encoding = Literal["raw", "jpeg"]

DEFAULT_PORT = 5000

HEADER = struct.Struct("<BHHBBI")
STAMP = struct.Struct("<IhhhI")
BEGIN_HEADER = struct.Struct("<BBII2x")
DATA_HEADER = struct.Struct("<B3x")
METADATA = struct.Struct(f"<BHHBBBII{STATE_FORMAT}IB3x64sIII4f")

MAGIC = 0xBC
ENCODINGS: tuple[Encoding, ...] = ("raw", "jpeg")
CHUNK_BYTES = 1020  # Bitcraze's largest packet of 1022 bytes, without its routing
STREAMER_CHUNK_BYTES = 4080
STREAMER_BEGIN, STREAMER_DATA, STREAMER_IMAGE, STREAMER_VERSION = 0x10, 0x11, 1, 10
SIDE_MAX_PX = 4096
IMAGE_MAX_BYTES = 1 << 22


@dataclass(frozen=True, slots=True)
class Image:
    """One image as the camera sent it.

    Parameters
    ----------
    width_px, height_px
        Its size.
    encoding
        "raw": one byte per pixel, row by row, behind red, green / green, blue filters on the
        colour version of the camera; or "jpeg".
    data
        The pixels, or the JPEG.
    time_us
        Time of exposure on the camera's clock, microseconds, unwrapped; None: not sent.
    frame_id
        Its number, unwrapped, so that a step of more than one is a loss; None: not sent.
    state
        Last state that the robot sent to the camera; None: none yet.
    """

    width_px: int
    height_px: int
    encoding: Encoding
    data: bytes
    time_us: int | None = None
    frame_id: int | None = None
    state: RobotState | None = None

    @property
    def robot_time_us(self) -> int | None:
        """Time of exposure on the robot's clock, derived from the state; None without a state."""
        if self.time_us is None or self.state is None:
            return None
        return self.time_us - self.state.received_us + 1000 * self.state.robot_ms


class ImageReader:
    """Decoder of images from a stream's bytes, in any layout.

    Attributes
    ----------
    broken
        Number of images that are incomplete or contradict their header.
    """

    def __init__(self) -> None:
        self.broken = 0
        self._packets = PacketReader()
        self._begun: _PartialImage | None = None
        self._headless_bytes = 0
        self._time_ms, self._time_us = CounterUnwrapper(32), CounterUnwrapper(32)
        self._robot_ms, self._frame_id = CounterUnwrapper(32), CounterUnwrapper(8, forward=True)

    @property
    def skipped_bytes(self) -> int:
        """Number of bytes that belonged to no packet, or to an image without its header."""
        return self._packets.skipped_bytes + self._headless_bytes

    def feed(self, data: bytes) -> Iterator[Image]:
        """Yield the images that these bytes complete."""
        for packet in self._packets.feed(data):
            image = self.add_packet(packet)
            if image is not None:
                yield image

    def finish(self) -> None:
        """End the stream. An incomplete image counts as broken."""
        amid = self._packets.finish()
        self.broken += amid or self._begun is not None
        self._begun = None

    def add_packet(self, packet: Packet) -> Image | None:
        """Add a packet; return the image that it completes, or None."""
        if packet.function == APP:
            return self._add_app_packet(packet.data)
        if packet.function == STREAMER and packet.data:
            return self._add_streamer_packet(packet.data)
        return None

    def _add_app_packet(self, data: bytes) -> Image | None:
        begun = self._begun
        if len(data) not in (HEADER.size, HEADER.size + STAMP.size) or data[0] != MAGIC:
            return self._append_chunk(data)
        header = self._parse_app_header(data)
        # Within an image, pixels may look like a header; before one, they are a broken header.
        if begun is not None and (header is None or len(data) == begun.missing):
            return self._append_chunk(data)
        self._start_image(header)
        return None

    def _parse_app_header(self, data: bytes) -> "_PartialImage | None":
        _, width_px, height_px, _, kind, size = HEADER.unpack_from(data)
        if kind >= len(ENCODINGS) or not _is_plausible_size(width_px, height_px, size):
            return None
        if ENCODINGS[kind] == "raw" and size != width_px * height_px:
            return None
        time_us = None
        if len(data) > HEADER.size:
            time_us = 1000 * self._time_ms(STAMP.unpack_from(data, HEADER.size)[0])
        return _PartialImage(size, Image(width_px, height_px, ENCODINGS[kind], b"", time_us))

    def _add_streamer_packet(self, data: bytes) -> Image | None:
        command = data[0]
        if command == STREAMER_BEGIN and len(data) >= BEGIN_HEADER.size:
            _, kind, size, checksum = BEGIN_HEADER.unpack_from(data)
            if kind != STREAMER_IMAGE:
                self._drop_image()
                return None
            sane = METADATA.size < size <= IMAGE_MAX_BYTES
            self._start_image(_PartialImage(size, None, checksum) if sane else None)
            return self._append_chunk(data[BEGIN_HEADER.size :])
        if command == STREAMER_DATA and len(data) >= DATA_HEADER.size:
            return self._append_chunk(data[DATA_HEADER.size :])
        self._drop_image()
        return None

    def _start_image(self, begun: "_PartialImage | None") -> None:
        self._drop_image()
        self._begun = begun
        self.broken += begun is None

    def _drop_image(self) -> None:
        self.broken += self._begun is not None
        self._begun = None

    def _append_chunk(self, data: bytes) -> Image | None:
        begun = self._begun
        if begun is None:
            self._headless_bytes += len(data)
            return None
        # Only the streamer pads its last packet to a multiple of four.
        spare = 3 if begun.image is None else 0
        if len(data) > begun.missing + spare:
            self._drop_image()
            return None
        begun.data += data[: begun.missing]
        if begun.missing:
            return None
        self._begun = None
        image = self._finish_image(begun)
        self.broken += image is None
        return image

    def _finish_image(self, begun: "_PartialImage") -> Image | None:
        data = bytes(begun.data)
        if begun.image is None:
            whole = begun.checksum in (0, compute_checksum(data))
            return self._parse_streamer_image(data) if whole else None
        image = begun.image
        if image.encoding == "jpeg" and not data.startswith(b"\xff\xd8"):
            return None
        return replace(image, data=data)

    def _parse_streamer_image(self, data: bytes) -> Image | None:
        version, width_px, height_px, _, _, frame_id, time_us, received_us, *rest = (
            METADATA.unpack_from(data)
        )
        pixels = data[METADATA.size :]
        if version != STREAMER_VERSION or len(pixels) != width_px * height_px or not pixels:
            return None
        frame_id, time_us = self._frame_id(frame_id), self._time_us(time_us)
        state = None
        if received_us:
            # Of the same clock as the image: a counter of its own may begin before a wrap.
            received_us = self._time_us.find_nearest(received_us)
            state = unpack_state(rest, self._robot_ms(rest[0]), received_us)
        return Image(width_px, height_px, "raw", pixels, time_us, frame_id, state)


@dataclass(slots=True)
class _PartialImage:
    """Incomplete image; ``image`` is None while its chunks contain metadata."""

    size: int
    image: Image | None
    checksum: int = 0
    data: bytearray = field(default_factory=bytearray)

    @property
    def missing(self) -> int:
        return self.size - len(self.data)


def _is_plausible_size(width_px: int, height_px: int, size: int) -> bool:
    return (
        0 < width_px <= SIDE_MAX_PX
        and 0 < height_px <= SIDE_MAX_PX
        and size > 0
        and (size <= IMAGE_MAX_BYTES)
    )


def compute_checksum(data: bytes) -> int:
    """Compute the CRC-32 of an image, as the streamer sends it."""
    # 0 means that there is no CRC, so a CRC of 0 is sent as all ones.
    return binascii.crc32(data) or 0xFFFFFFFF
