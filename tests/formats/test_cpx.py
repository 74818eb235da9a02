import struct

import numpy as np
import pytest

from dmrl.formats import cpx
from dmrl.formats.cpx import Image, ImageReader
from dmrl.formats.cpx_pack import pack_image
from dmrl.formats.cpx_packets import (
    APP,
    GAP8,
    HOST,
    Packet,
    PacketReader,
    pack_packet,
)
from dmrl.formats.cpx_state import State, compressed, quaternion

RNG = np.random.default_rng(8)
JPEG = b"\xff\xd8" + RNG.bytes(3000) + b"\xff\xd9"


def raw(width_px: int = 324, height_px: int = 244, **more: object) -> Image:
    data = RNG.bytes(width_px * height_px)
    return Image(width_px, height_px, "raw", data, **more)  # type: ignore[arg-type]


def read(data: bytes, step: int = 1400) -> tuple[list[Image], ImageReader]:
    reader = ImageReader()
    parts = [data[k : k + step] for k in range(0, len(data), step)]
    return [image for part in parts for image in reader.feed(part)], reader


@pytest.mark.parametrize("step", [1, 7, 1400, 1 << 20])
def test_raw_and_jpeg_images_come_back_however_the_bytes_are_cut(step: int) -> None:
    sent = [raw(40, 51), Image(324, 244, "jpeg", JPEG), raw(2, 2)]
    got, reader = read(b"".join(pack_image(image) for image in sent), step)
    assert got == sent
    assert (reader.broken, reader.skipped_bytes) == (0, 0)


def test_the_first_bytes_of_an_image_are_those_that_the_published_viewer_reads() -> None:
    data = pack_image(raw(320, 224))
    length, route, function = struct.unpack_from("<HBB", data)
    assert (length, route & 7, route >> 3 & 7, function) == (13, 3, 4, 5)
    assert struct.unpack_from("<BHHBBI", data, 4) == (0xBC, 320, 224, 1, 0, 71680)
    assert struct.unpack_from("<H", data, 15) == (1022,)


def test_an_image_of_whole_packets_ends_with_an_empty_one() -> None:
    image = raw(1020, 2)
    data = pack_image(image)
    assert data.endswith(struct.pack("<HBB", 2, 0x63, 5))
    assert read(data + data)[0] == [image, image]


def test_a_stamped_image_has_its_time_in_whole_milliseconds() -> None:
    image = raw(8, 8, time_us=123_000)
    assert read(pack_image(image, "stamped"))[0] == [image]


def test_streamer_images_keep_number_times_and_state_over_their_wraps() -> None:
    sent = []
    for k in range(600):
        time_us = (1 << 32) - 10_000_000 + 50_000 * k
        state = State(4_294_967_000 + 50 * k, time_us - 4_000, (0.25, -1.5, 0.4))
        sent.append(raw(16, 12, time_us=time_us, frame_id=250 + k, state=state))
    got, reader = read(b"".join(pack_image(image, "streamer") for image in sent))
    assert [g.time_us for g in got] == [s.time_us for s in sent]
    assert [g.frame_id for g in got] == [s.frame_id for s in sent]
    assert [g.robot_time_us for g in got] == [s.robot_time_us for s in sent]
    assert [g.data for g in got] == [s.data for s in sent]
    assert got[7].state is not None and got[7].state.position_m == (0.25, -1.5, 0.4)
    assert reader.broken == 0


def test_streamer_metadata_is_148_bytes_and_its_length_leaves_the_routing_out() -> None:
    assert cpx.METADATA.size == 148
    data = pack_image(raw(10, 10, time_us=5, frame_id=1), "streamer")
    assert struct.unpack_from("<HBB", data) == (12 + 148 + 100, 0x63, 6)
    assert struct.unpack_from("<BBI", data, 4) == (0x10, 1, 148 + 100)  # begins, an image


def test_a_changed_byte_of_a_streamer_image_breaks_it_and_no_other() -> None:
    one, other = raw(16, 16, time_us=1, frame_id=1), raw(16, 16, time_us=2, frame_id=2)
    data = bytearray(pack_image(one, "streamer"))
    data[300] ^= 1
    got, reader = read(bytes(data) + pack_image(other, "streamer"))
    assert (got, reader.broken) == ([other], 1)


@pytest.mark.parametrize("layout", ["plain", "stamped", "streamer"])
def test_a_stream_joined_in_the_middle_is_read_from_the_next_image(layout: cpx.Layout) -> None:
    images = [raw(60, 50, time_us=k * 1000, frame_id=k) for k in range(4)]
    data = b"".join(pack_image(image, layout) for image in images)
    got, reader = read(data[777:])
    assert [image.data for image in got] == [image.data for image in images[1:]]
    assert reader.skipped_bytes > 0


def test_garbage_gives_no_image_and_images_after_it_are_found() -> None:
    image = raw(60, 50)
    got, reader = read(RNG.bytes(200_000) + pack_image(image) * 3)
    assert got[-2:] == [image, image]
    assert reader.skipped_bytes > 190_000


def test_a_packet_lost_amid_an_image_breaks_that_image_only() -> None:
    image = raw(60, 50)
    packets = list(PacketReader().feed(pack_image(image)))
    torn = b"".join(pack_packet(packet) for k, packet in enumerate(packets) if k != 2)
    got, reader = read(torn + pack_image(image))
    assert (got, reader.broken) == ([image], 1)


def test_a_header_of_a_wrong_size_is_a_broken_image() -> None:
    header = cpx.HEADER.pack(cpx.MAGIC, 324, 244, 1, 0, 1000)
    data = pack_packet(Packet(GAP8, HOST, APP, header)) + pack_packet(
        Packet(GAP8, HOST, APP, bytes(1000))
    )
    got, reader = read(data)
    assert (got, reader.broken) == ([], 1)


def test_console_text_and_other_functions_are_passed_over() -> None:
    image = raw(20, 20)
    text = pack_packet(Packet(GAP8, HOST, 2, b"Starting camera task"))
    got, reader = read(text + pack_image(image) + text)
    assert (got, reader.broken, reader.skipped_bytes) == ([image], 0, 0)


def test_quaternions_come_back_to_a_quarter_of_a_degree() -> None:
    for xyzw in RNG.normal(size=(50, 4)):
        xyzw /= np.linalg.norm(xyzw)
        back = np.array(quaternion(compressed(tuple(xyzw))))
        angle_rad = 2 * np.arccos(min(abs(float(back @ xyzw)), 1.0))
        assert angle_rad < np.deg2rad(0.25)
