"""Images in CPX streams: layouts, limits, and damaged packets."""

import struct

import numpy as np
import pytest

from dmrl.formats.aideck import cpx
from dmrl.formats.aideck.cpx import Image, ImageReader
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.formats.aideck.cpx_log import (
    APP,
    GAP8,
    HOST,
    STREAMER,
    Packet,
    PacketReader,
    pack_packet,
)
from dmrl.formats.aideck.cpx_state import RobotState, compress_quaternion, decompress_quaternion

from .test_cpx_log import pack_app_packet

RNG = np.random.default_rng(8)
JPEG = b"\xff\xd8" + RNG.bytes(3000) + b"\xff\xd9"


def make_raw_image(width_px: int = 324, height_px: int = 244, **more: object) -> Image:
    """Return a raw image of random pixels."""
    data = RNG.bytes(width_px * height_px)
    return Image(width_px, height_px, "raw", data, **more)  # type: ignore[arg-type]


def read_images(data: bytes, step: int = 1400) -> tuple[list[Image], ImageReader]:
    """Feed data to a reader in parts of ``step`` bytes; return the images and the reader."""
    reader = ImageReader()
    parts = [data[k : k + step] for k in range(0, len(data), step)]
    return [image for part in parts for image in reader.feed(part)], reader


@pytest.mark.parametrize("step", [1, 7, 1400, 1 << 20])
def test_raw_and_jpeg_images_round_trip_for_any_chunking(step: int) -> None:
    sent = [make_raw_image(40, 51), Image(324, 244, "jpeg", JPEG), make_raw_image(2, 2)]
    got, reader = read_images(b"".join(pack_image(image) for image in sent), step)
    assert got == sent
    assert (reader.broken, reader.skipped_bytes) == (0, 0)


def test_image_header_matches_the_published_viewer() -> None:
    data = pack_image(make_raw_image(320, 224))
    length, route, function = struct.unpack_from("<HBB", data)
    assert (length, route & 7, route >> 3 & 7, function) == (13, 3, 4, 5)
    assert struct.unpack_from("<BHHBBI", data, 4) == (0xBC, 320, 224, 1, 0, 71680)
    assert struct.unpack_from("<H", data, 15) == (1022,)


def test_an_image_of_whole_packets_ends_with_an_empty_one() -> None:
    image = make_raw_image(1020, 2)
    data = pack_image(image)
    assert data.endswith(struct.pack("<HBB", 2, 0x63, 5))
    assert read_images(data + data)[0] == [image, image]


def test_a_stamped_image_has_its_time_in_whole_milliseconds() -> None:
    image = make_raw_image(8, 8, time_us=123_000)
    assert read_images(pack_image(image, "stamped"))[0] == [image]


@pytest.mark.heavy
def test_streamer_images_keep_number_times_and_state_over_their_wraps() -> None:
    sent = []
    for k in range(600):
        time_us = (1 << 32) - 10_000_000 + 50_000 * k
        state = RobotState(4_294_967_000 + 50 * k, time_us - 4_000, (0.25, -1.5, 0.4))
        sent.append(make_raw_image(16, 12, time_us=time_us, frame_id=250 + k, state=state))
    got, reader = read_images(b"".join(pack_image(image, "streamer") for image in sent))
    assert [g.time_us for g in got] == [s.time_us for s in sent]
    assert [g.frame_id for g in got] == [s.frame_id for s in sent]
    assert [g.robot_time_us for g in got] == [s.robot_time_us for s in sent]
    assert [g.data for g in got] == [s.data for s in sent]
    assert got[7].state is not None and got[7].state.position_m == (0.25, -1.5, 0.4)
    assert reader.broken == 0


def test_streamer_length_includes_metadata_without_routing() -> None:
    assert cpx.METADATA.size == 148
    data = pack_image(make_raw_image(10, 10, time_us=5, frame_id=1), "streamer")
    assert struct.unpack_from("<HBB", data) == (12 + 148 + 100, 0x63, 6)
    assert struct.unpack_from("<BBI", data, 4) == (0x10, 1, 148 + 100)  # first packet of an image


def test_a_changed_byte_of_a_streamer_image_breaks_it_and_no_other() -> None:
    one, other = (make_raw_image(16, 16, time_us=k, frame_id=k) for k in (1, 2))
    data = bytearray(pack_image(one, "streamer"))
    data[300] ^= 1
    got, reader = read_images(bytes(data) + pack_image(other, "streamer"))
    assert (got, reader.broken) == ([other], 1)


@pytest.mark.parametrize("layout", ["plain", "stamped", "streamer"])
def test_a_stream_joined_in_the_middle_is_read_from_the_next_image(layout: cpx.Layout) -> None:
    images = [make_raw_image(60, 50, time_us=k * 1000, frame_id=k) for k in range(4)]
    data = b"".join(pack_image(image, layout) for image in images)
    got, reader = read_images(data[777:])
    assert [image.data for image in got] == [image.data for image in images[1:]]
    assert reader.skipped_bytes > 0


def test_garbage_gives_no_image_and_images_after_it_are_found() -> None:
    image = make_raw_image(60, 50)
    got, reader = read_images(RNG.bytes(200_000) + pack_image(image) * 3)
    assert got[-2:] == [image, image]
    assert reader.skipped_bytes > 190_000


def test_a_packet_lost_amid_an_image_breaks_that_image_only() -> None:
    image = make_raw_image(60, 50)
    packets = list(PacketReader().feed(pack_image(image)))
    torn = b"".join(pack_packet(packet) for k, packet in enumerate(packets) if k != 2)
    got, reader = read_images(torn + pack_image(image))
    assert (got, reader.broken) == ([image], 1)


def test_a_header_of_a_wrong_size_is_a_broken_image() -> None:
    header = cpx.HEADER.pack(cpx.MAGIC, 324, 244, 1, 0, 1000)
    data = pack_packet(Packet(GAP8, HOST, APP, header)) + pack_packet(
        Packet(GAP8, HOST, APP, bytes(1000))
    )
    got, reader = read_images(data)
    assert (got, reader.broken) == ([], 1)


def test_console_text_and_other_functions_are_passed_over() -> None:
    image = make_raw_image(20, 20)
    text = pack_packet(Packet(GAP8, HOST, 2, b"Starting camera task"))
    got, reader = read_images(text + pack_image(image) + text)
    assert (got, reader.broken, reader.skipped_bytes) == ([image], 0, 0)


def test_quaternions_round_trip_within_a_quarter_of_a_degree() -> None:
    for xyzw in RNG.normal(size=(50, 4)):
        xyzw /= np.linalg.norm(xyzw)
        back = np.array(decompress_quaternion(compress_quaternion(tuple(xyzw))))
        angle_rad = 2 * np.arccos(min(abs(float(back @ xyzw)), 1.0))
        assert angle_rad < np.deg2rad(0.25)


def test_missing_camera_fields_are_packed_as_zero() -> None:
    bare = make_raw_image(8, 8)
    (streamed,), _ = read_images(pack_image(bare, "streamer"))
    assert (streamed.frame_id, streamed.time_us, streamed.state) == (0, 0, None)
    assert streamed.robot_time_us is None
    stamped = pack_image(bare, "stamped")
    assert cpx.STAMP.unpack_from(stamped, 4 + cpx.HEADER.size) == (0, 0, 0, 0, 0)
    assert make_raw_image(8, 8, time_us=9).robot_time_us is None


def test_stamp_has_milliseconds_and_robot_state() -> None:
    state = RobotState(5, 6, (0.1, -0.2, 0.3), quaternion_xyzw=(1.0, 0.0, 0.0, 0.0))
    data = pack_image(
        make_raw_image(8, 8, time_us=(2**32 + 5) * 1000 + 999, state=state), "stamped"
    )
    assert cpx.STAMP.unpack_from(data, 4 + cpx.HEADER.size) == (5, 100, -200, 300, 0)


def test_streamer_metadata_stands_where_the_firmware_has_it() -> None:
    state = RobotState(5, 2**32 + 6, (0.1, -0.2, 0.3))
    image = make_raw_image(10, 12, time_us=2**32 + 9, frame_id=258, state=state)
    data = pack_image(image, "streamer")[4 + cpx.BEGIN_HEADER.size :]
    assert struct.unpack_from("<BHHBBBIII3h", data) == (
        *(10, 10, 12, 1, 0, 2, 9, 6),
        *(5, 100, -200, 300),
    )
    assert data[52:148] == bytes(96)  # fields of the firmware that dmrl does not set
    assert data[148 : 148 + 120] == image.data


def test_robot_time_is_extrapolated_from_its_last_state() -> None:
    image = make_raw_image(8, 8, time_us=10_000, state=RobotState(7, 4_000))
    assert image.robot_time_us == 7_000 + 6_000


@pytest.mark.parametrize(
    ("size", "whole"),
    [((4096, 1), True), ((4097, 1), False), ((1, 4096), True), ((1, 4097), False)],
)
def test_a_picture_s_side_is_4096_pixels_at_most(size: tuple[int, int], whole: bool) -> None:
    got, reader = read_images(pack_image(make_raw_image(*size)))
    assert (len(got), reader.broken) == (whole, not whole)


def test_truncated_last_image_is_counted_once() -> None:
    reader = ImageReader()
    list(reader.feed(pack_image(make_raw_image(60, 50))[:1500]))
    reader.finish()
    assert reader.broken == 1
    reader.finish()
    assert reader.broken == 1


def test_a_streamer_image_without_a_checksum_is_taken() -> None:
    image = make_raw_image(10, 10, time_us=5, frame_id=1)
    data = bytearray(pack_image(image, "streamer"))
    data[10:14] = bytes(4)
    assert [got.data for got in read_images(bytes(data))[0]] == [image.data]
    data[10:14] = b"\1\0\0\0"
    got, reader = read_images(bytes(data))
    assert (got, reader.broken) == ([], 1)


def test_a_jpeg_that_does_not_begin_as_one_is_broken() -> None:
    got, reader = read_images(pack_image(Image(32, 24, "jpeg", b"\xff\xd9" + bytes(90))))
    assert (got, reader.broken) == ([], 1)


@pytest.mark.parametrize("cut", range(1, 40))
def test_packet_reader_is_independent_of_chunk_boundaries_after_garbage(cut: int) -> None:
    packet = pack_packet(Packet(GAP8, HOST, APP, b"abcdef"))
    data = b"\0" * 25 + packet * 2
    reader = PacketReader()
    got = [*reader.feed(data[:cut]), *reader.feed(data[cut:])]
    reader.finish()
    assert [p.data for p in got] == [b"abcdef"] * 2 or cut > len(data)
    assert reader.skipped_bytes == 25


@pytest.mark.parametrize(("width", "packets"), [(1019, 2), (1020, 3), (1021, 3), (2039, 3)])
def test_an_image_ends_with_its_first_packet_that_is_not_full(width: int, packets: int) -> None:
    image = make_raw_image(width, 1)
    assert len(list(PacketReader().feed(pack_image(image)))) == packets
    assert read_images(pack_image(image) * 2)[0] == [image, image]


@pytest.mark.parametrize("width", [100, 4080 - 12 - 148, 4080 - 12 - 147, 4500, 8996, 12_001])
def test_streamer_images_of_many_packets_round_trip(width: int) -> None:
    sent = [make_raw_image(width, 1, time_us=7 + k, frame_id=k) for k in range(2)]
    data = b"".join(pack_image(image, "streamer") for image in sent)
    got, reader = read_images(data)
    assert [image.data for image in got] == [image.data for image in sent]
    assert (reader.broken, reader.skipped_bytes) == (0, 0)
    packets = list(PacketReader().feed(pack_image(sent[0], "streamer")))
    sizes = [len(packet.data) for packet in packets]
    assert sizes[:-1] == [4080] * (len(sizes) - 1) and sizes[-1] <= 4080
    assert all(size % 4 == 0 for size in sizes)
    assert packets[0].data[:2] == b"\x10\1"
    assert all(packet.data[:4] == b"\x11\0\0\0" for packet in packets[1:])
    pixels = packets[0].data[12 + 148 :] + b"".join(packet.data[4:] for packet in packets[1:])
    assert pixels[:width] == sent[0].data and 0 <= len(pixels) - width < 4


@pytest.mark.parametrize("layout", ["plain", "stamped", "streamer"])
def test_interleaved_packets_do_not_break_an_image(layout: cpx.Layout) -> None:
    image = make_raw_image(90, 100, time_us=9000, frame_id=1)
    packets = [pack_packet(p) for p in PacketReader().feed(pack_image(image, layout))]
    words = b"Starting camera task"
    counted = (
        0 if layout == "streamer" else 2
    )  # routing bytes that this firmware includes in the length
    text = struct.pack("<HBB", len(words) + counted, 3 | 4 << 3 | 1 << 6, 2) + words
    got, reader = read_images(text.join(packets))
    assert [found.data for found in got] == [image.data]
    assert reader.broken == 0


def test_a_plain_image_has_not_a_byte_too_many() -> None:
    header = cpx.HEADER.pack(cpx.MAGIC, 10, 10, 1, 0, 100)
    for sizes, count in (((60, 40), 1), ((60, 41), 0), ((100,), 1), ((101,), 0)):
        got, reader = read_images(
            b"".join(map(pack_app_packet, [header, *(bytes(size) for size in sizes)]))
        )
        assert (len(got), reader.broken) == (count, 1 - count)


def test_a_streamer_image_has_up_to_three_bytes_to_spare() -> None:
    begin = next(PacketReader().feed(pack_image(make_raw_image(10, 10), "streamer"))).data
    for spare, count in ((0, 1), (3, 1), (4, 0)):
        data = pack_packet(Packet(GAP8, HOST, STREAMER, begin + bytes(spare)))
        got, reader = read_images(data)
        assert (len(got), reader.broken) == (count, 1 - count)


@pytest.mark.parametrize(
    ("at", "value", "whole"),
    [(0, 10, True), (0, 9, False), (1, 11, False), (3, 11, False), (3, 0, False)],
)
def test_streamer_metadata_is_of_version_10_and_of_as_many_pixels(
    at: int, value: int, whole: bool
) -> None:
    data = bytearray(pack_image(make_raw_image(10, 10), "streamer"))
    data[10:14] = bytes(4)  # no checksum
    data[4 + cpx.BEGIN_HEADER.size + at] = value
    got, reader = read_images(bytes(data))
    assert (len(got), reader.broken) == (whole, not whole)


@pytest.mark.parametrize(
    ("kind", "size", "broken"),
    [(1, 149, 0), (1, 148, 1), (1, 1 << 22, 0), (1, (1 << 22) + 1, 1), (2, 200, 0)],
)
def test_streamer_header_limits_are_checked(kind: int, size: int, broken: int) -> None:
    reader = ImageReader()
    begin = cpx.BEGIN_HEADER.pack(cpx.STREAMER_BEGIN, kind, size, 0)
    list(reader.feed(pack_packet(Packet(GAP8, HOST, STREAMER, begin))))
    assert reader.broken == broken
    reader.finish()
    assert reader.broken == (1 if kind == 1 else 0)  # only an image that has begun can be broken


@pytest.mark.parametrize("data", [b"\x10\1", b"\x11\0", b"\x12\0\0\0"])
def test_invalid_streamer_packet_breaks_the_current_image(data: bytes) -> None:
    first, *_ = PacketReader().feed(pack_image(make_raw_image(90, 100), "streamer"))
    reader = ImageReader()
    list(reader.feed(pack_packet(first)))
    list(reader.feed(pack_packet(Packet(GAP8, HOST, STREAMER, data))))
    assert reader.broken == 1


def test_a_stamp_s_milliseconds_wrap() -> None:
    sent = [make_raw_image(8, 8, time_us=(2**32 - 2 + k) * 1000) for k in range(4)]
    got, _ = read_images(b"".join(pack_image(image, "stamped") for image in sent))
    assert [image.time_us for image in got] == [image.time_us for image in sent]


def test_a_streamer_packet_without_pixels_breaks_nothing() -> None:
    image = make_raw_image(90, 100)
    first, *rest = (pack_packet(p) for p in PacketReader().feed(pack_image(image, "streamer")))
    bare = pack_packet(Packet(GAP8, HOST, STREAMER, b"\x11\0\0\0"))
    got, reader = read_images(b"".join([first, bare, *rest]))
    assert ([found.data for found in got], reader.broken) == ([image.data], 0)


def test_an_image_without_its_header_is_counted() -> None:
    packets = list(PacketReader().feed(pack_image(Image(324, 244, "jpeg", JPEG))))
    got, reader = read_images(
        b"".join(map(pack_packet, packets[1:])) + pack_image(make_raw_image(40, 51))
    )
    assert len(got) == 1
    assert reader.skipped_bytes == len(JPEG)
