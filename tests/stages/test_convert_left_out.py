"""Counts of omissions agree in standard error, --json, provenance and --strict."""

import json
from pathlib import Path

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.formats.aideck.cpx import Image
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.images.bayer import demosaic
from dmrl.images.codec import decode
from dmrl.recording import read, read_summary

from ..formats import plain_usd


def run_dmrl(words: list[str]) -> int:
    """Run a command in this process; return its exit status."""
    return boundary.run_to_status(lambda: app(words, result_action="return_value"))


@pytest.fixture
def cut_log(tmp_path: Path) -> Path:
    """Return a micro-SD log without its last eleven bytes."""
    path = tmp_path / "log00"
    path.write_bytes(
        plain_usd.encode(
            {1: ("state", [("stateEstimate.z", "f")])},
            [(1, 1000 * k, (0.01 * k,)) for k in range(50)],
        )[:-11]
    )
    return path


def test_counts_are_in_json_provenance_and_info(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert run_dmrl(["convert", str(cut_log), str(out), "--json"]) == 0
    told = capsys.readouterr()
    counts = json.loads(told.out)["left_out"]
    ((reason, count),) = counts.items()
    assert reason == "bytes that are no whole record" and count > 0
    assert f"left out: {reason}: {count} (first at {cut_log}: byte" in told.err
    made = read_summary(out).provenance
    assert made is not None and made.left_out == counts
    assert run_dmrl(["info", str(out)]) == 0
    assert f"left out: {reason}: {count}" in capsys.readouterr().out


def test_strict_leaves_nothing_behind(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert run_dmrl(["convert", str(cut_log), str(out), "--strict"]) == 1
    assert "--strict" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log00"]


@pytest.mark.heavy
def test_flags_without_effect_are_errors(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    for flags, named in (
        (["--width-px", "320", "--height-px", "224"], "--width-px and --height-px"),
        (["--camera", "aideck"], "--camera"),
        (["--raw"], "--raw"),
        (["--rate-hz", "20"], "--rate-hz"),
        (["--labels", "labels.csv"], "--labels"),
    ):
        assert run_dmrl(["convert", str(cut_log), str(out), *flags]) == 1
        assert f"{named} has no effect on a micro-SD log" in capsys.readouterr().err
        assert not out.exists()
    assert run_dmrl(["convert", str(cut_log), str(out)]) == 0
    capsys.readouterr()
    assert run_dmrl(["convert", str(out), str(tmp_path / "t"), "--to", "parquet", "--raw"]) == 1
    assert "--raw has no effect with --to parquet" in capsys.readouterr().err


@pytest.mark.heavy
def test_full_sensor_stream_is_cropped_for_the_shipped_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Raw images of 324 x 244 px are cropped to 320 x 224 px, the size of the calibration."""
    pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    pixels = [rng.integers(0, 256, (244, 324), np.uint8) for _ in range(3)]
    packets = [
        pack_image(Image(324, 244, "raw", raw.tobytes(), 50_000 * k, k), "streamer")
        for k, raw in enumerate(pixels)
    ]
    (tmp_path / "flight.cpx").write_bytes(b"".join(packets))
    source, out = str(tmp_path / "flight.cpx"), tmp_path / "out.mcap"
    assert run_dmrl(["convert", source, str(out), "--camera", "aideck"]) == 0
    images = [decode(s.message.data) for s in read(out, "/cf1/camera/image")]
    # The crop is in the middle of the sensor, 2 columns and 10 rows from its corner.
    for rgb, raw in zip(images, pixels, strict=True):
        np.testing.assert_array_equal(rgb, demosaic(raw)[10:234, 2:322])
    (calibration,) = read(out, "/cf1/camera/calibration")
    assert (calibration.message.width, calibration.message.height) == (320, 224)
    half = str(tmp_path / "half.mcap")
    assert run_dmrl(["convert", source, half, "--width-px", "162", "--height-px", "122"]) == 0
    assert decode(next(read(Path(half), "/cf1/camera/image")).message.data).shape == (122, 162, 3)
    capsys.readouterr()
    for flags, words in (
        (["--raw"], "--raw has no effect: the images of"),
        (["--rate-hz", "5"], "--rate-hz has no effect:"),
        (["--labels", source], "--labels has no effect on a recorded CPX stream"),
    ):
        assert run_dmrl(["convert", source, str(tmp_path / "x.mcap"), *flags]) == 1
        assert words in capsys.readouterr().err


@pytest.mark.heavy
def test_flags_without_effect_on_a_folder_are_errors(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "swarm").mkdir()
    cut_log.rename(tmp_path / "swarm" / "cf7")
    out = str(tmp_path / "out.mcap")
    assert run_dmrl(["convert", str(tmp_path / "swarm"), out, "--robot", "a"]) == 1
    assert "--robot has no effect: the files of" in capsys.readouterr().err
    (tmp_path / "flight").mkdir()
    head = "time_s,roll_rad,pitch_rad,yaw_rate_radps,vx_mps,vy_mps,height_m"
    rows = [f"{0.1 * k:.1f},0,0,0,{k},0,1" for k in range(5)]
    (tmp_path / "flight" / "cf1.csv").write_text("\n".join([head, *rows]))
    assert run_dmrl(["convert", str(tmp_path / "flight"), out, "--camera", "aideck"]) == 1
    assert "--camera has no effect: " in capsys.readouterr().err
    assert run_dmrl(["convert", str(tmp_path / "flight"), out]) == 0
