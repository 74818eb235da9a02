"""HyperFlash dumps become images, logs and labels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.aideck import hyperflash
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.geometry.frames import AIDECK
from dmrl.images.bayer import demosaic, to_bayer
from dmrl.images.codec import Rgb, decode
from dmrl.samples.sample import Sample

from .. import foreign

VALUES = (
    (1.5, -2.25, 1.1, 0.2, -0.05, 1.2),
    (0.1, 0.3, 0.7, -0.3, 0.11, 0.77),
    (-3.7, 8.9, 2.0, 0.4, 0.3, 2.06),
)


def make_images() -> list[Rgb]:
    """Return three images: one colour, ramps, and two colours side by side.

    A Bayer filter keeps enough of each to restore the pixels that it samples.
    """
    v, u = np.mgrid[:224, :320]
    plain = np.empty((224, 320, 3), np.uint8)
    plain[:] = (200, 30, 90)
    ramp = np.stack([u // 2 * 2 % 160 + 20, v + 10, 180 - v // 2 * 2 % 160], axis=-1)
    halves = np.where((u < 160)[..., None], plain, plain[..., ::-1])
    return [plain, ramp.astype(np.uint8), halves.astype(np.uint8)]


@pytest.fixture
def dump(tmp_path: Path) -> Path:
    """Return a dump of three records and an end marker."""
    path = tmp_path / "flash.bin"
    path.write_bytes(foreign.pack_flash_dump([to_bayer(p) for p in make_images()], VALUES))
    return path


def read_samples(path: Path, message: str, options: Options | None = None) -> list[Sample]:
    """Return the samples of a message type, or of the logged variables for ``log``."""
    found = hyperflash.load_content(path, options or Options()).samples
    return [s for s in found if (s.message if isinstance(s.message, str) else "log") == message]


def test_images_are_decoded_exactly(dump: Path) -> None:
    found = [decode(s.fields["data"]) for s in read_samples(dump, "CompressedImage")]
    plain, ramp, halves = make_images()
    assert len(found) == 3
    np.testing.assert_array_equal(found[0], plain)
    # Each pixel keeps the colour that its filter let through.
    for got, known in zip(found, (plain, ramp, halves), strict=True):
        np.testing.assert_array_equal(to_bayer(got)[1:-1, 1:-1], to_bayer(known)[1:-1, 1:-1])
        np.testing.assert_array_equal(got, demosaic(to_bayer(known)))
    np.testing.assert_array_equal(found[2][:, :158], halves[:, :158])


def test_numbers_are_decoded_exactly(dump: Path) -> None:
    wanted = np.array(VALUES, np.float32).astype(float)
    logged = [list(s.fields.values()) for s in read_samples(dump, "log")]
    assert (np.array(logged) == wanted).all()
    places = [[s.fields[axis] for axis in "xyz"] for s in read_samples(dump, "PeerPosition")]
    assert (np.array(places) == wanted[:, 2:5]).all()
    assert [s.fields["range_m"] for s in read_samples(dump, "UwbRange")] == wanted[:, 5].tolist()
    attitude = read_samples(dump, "Attitude")[0].fields
    assert attitude["roll_rad"] == pytest.approx(np.radians(1.5))
    assert attitude["pitch_rad"] == pytest.approx(np.radians(2.25))  # logged nose up


def test_the_peer_is_labelled_where_the_firmware_had_it(dump: Path) -> None:
    (peer,) = read_samples(dump, "PeerLabels", Options(names={"0": "cf5"}))[0].fields["peers"]
    assert (peer["peer"], peer["source"]) == ("cf5", "estimate")
    # 1.1 m ahead, 0.2 m left: left of the principal point at 166.9 px.
    assert peer["u_px"] == pytest.approx(166.9 - 183.73 * 0.2 / 1.1, abs=2)
    assert peer["depth_m"] == pytest.approx(1.1, abs=0.02)


def test_times_follow_the_nominal_rate(dump: Path) -> None:
    times = [s.time_ns for s in read_samples(dump, "CompressedImage", Options(rate_hz=4))]
    assert times == [0, 250_000_000, 500_000_000]


def test_reading_stops_at_the_end_marker(dump: Path) -> None:
    dump.write_bytes(dump.read_bytes() + dump.read_bytes())
    assert len(read_samples(dump, "CompressedImage")) == 3


@pytest.mark.parametrize("length", [1, 71_679, 71_680, 71_703])
def test_truncated_record_is_omitted_and_reported(
    dump: Path, length: int, capsys: pytest.CaptureFixture[str]
) -> None:
    dump.write_bytes(dump.read_bytes()[: 2 * 71_704 + length])
    assert len(read_samples(dump, "CompressedImage")) == 2
    said = f"left out: records that are cut short: 1 (at {dump}: its last {length} bytes)"
    assert said in capsys.readouterr().err


def test_a_dump_without_end_marker_ends_with_the_file(
    dump: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dump.write_bytes(dump.read_bytes()[: 3 * 71_704])
    assert len(read_samples(dump, "CompressedImage")) == 3
    assert capsys.readouterr().err == ""


def test_impossible_numbers_make_no_label(dump: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = ((float("nan"), 0, 1, 0, 0, 1), *VALUES[1:])
    dump.write_bytes(foreign.pack_flash_dump([to_bayer(p) for p in make_images()], values))
    assert len(read_samples(dump, "CompressedImage")) == 3
    assert "left out: labels of records with impossible numbers: 1" in capsys.readouterr().err
    assert len(read_samples(dump, "PeerLabels")) == 2


def test_an_erased_flash_holds_no_record(tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    path.write_bytes(b"\xff" * 71_704 * 2)
    with pytest.raises(SourceError, match="has no record of 71704 bytes"):
        hyperflash.load_content(path, Options())


def test_hyperflash_dump_is_recognized_by_plausible_numbers(dump: Path) -> None:
    assert find_format(dump).name == "hyperflash"
    noise = np.random.default_rng(0).integers(0, 256, 100_000, np.uint8).tobytes()
    dump.write_bytes(noise)
    assert not hyperflash.can_read(dump)


def test_bytes_of_something_else_are_refused(dump: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, 2 * 71_704, np.uint8).tobytes()
    for other in (noise, b"?" + dump.read_bytes()):
        (path := dump.with_name("other.bin")).write_bytes(other)
        with pytest.raises(SourceError, match=r"other\.bin: \d of \d records have impossible"):
            hyperflash.load_content(path, Options())


def test_bayer_order_matches_real_frames(data: Path) -> None:
    for number in ("00216", "00375", "00495"):
        rgb = decode((data / "aideck-frames" / f"img{number}.ppm").read_bytes())
        again = demosaic(to_bayer(rgb))[2:-2, 2:-2].astype(int)
        assert np.abs(again - rgb[2:-2, 2:-2]).max() <= 1


@pytest.mark.parametrize(("odd", "of", "taken"), [(1, 3, True), (1, 2, False), (2, 3, False)])
def test_most_records_of_a_dump_are_plausible(odd: int, of: int, taken: bool, dump: Path) -> None:
    values = [*[(1e9,) * 6] * odd, *[VALUES[0]] * (of - odd)]
    dump.write_bytes(foreign.pack_flash_dump([to_bayer(p) for p in make_images()[:of]], values))
    if taken:
        assert len(read_samples(dump, "CompressedImage")) == of
    else:
        with pytest.raises(SourceError, match=f"{odd} of {of} records have impossible"):
            hyperflash.load_content(dump, Options())


def test_dump_is_recognized_by_whole_records_and_erased_flash(dump: Path) -> None:
    whole = dump.read_bytes()[:71_704]
    for data, known in (
        (whole, True),
        (whole + b"\xff" * 100, True),
        (whole + b"\0" * 100, False),
        (whole[:-1], False),
        (whole[:-24] + bytes(24), False),
    ):
        dump.write_bytes(data)
        assert hyperflash.can_read(dump) == known


def test_the_camera_comes_first_and_peers_are_named(dump: Path) -> None:
    first, *rest = hyperflash.load_content(dump, Options(robot="me", names={"0": "you"})).samples
    assert (first.topic, first.time_ns) == ("/me/camera/calibration", 0)
    assert first.fields["K"][2] == AIDECK.cx_px
    assert {s.topic for s in rest if "range" in s.topic} == {"/me/range/you"}
    camera = replace(AIDECK, cx_px=99.5)
    first, *_ = hyperflash.load_content(dump, Options(camera=camera)).samples
    assert first.fields["K"][2] == 99.5
    assert hyperflash.load_content(dump, Options()).total == 4  # three records, and the erased one
