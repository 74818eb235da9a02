"""Warnings of `dmrl label` about faulty flights."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dmrl.errors import RecordingError, SettingError, SourceError
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import AIDECK
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    Stamped,
    read,
)
from dmrl.stages import label
from dmrl.stages.label import Settings
from dmrl.terminal.left_out import count_left_out

from .test_label import LENIENT, SECOND_NS

pytestmark = pytest.mark.heavy

Change = Callable[[Stamped], list[Stamped]]


@pytest.fixture
def change_flight(flight: Path, tmp_path: Path) -> Callable[[Change], Path]:
    """Return a function that writes the flight's logs with every message change_flight."""

    def make(change: Change) -> Path:
        out = tmp_path / "changed.mcap"
        with RecordingWriter(out, Provenance("test")) as sink:
            for stamped in read(flight, "/*/attitude", "/*/velocity", "/*/height", "/*/range/*"):
                for one in change(stamped):
                    sink.write(one.time_ns, one.topic, one.message)
        return out

    return make


def label_and_warn(path: Path) -> str:
    """Label a flight; return its warnings, one a line."""
    out = path.with_name("out.mcap")
    return "\n".join(label.run(path, out, Settings(method="ekf")).warnings)


def test_impossible_ranges_are_omitted_and_reported(
    change_flight: Callable[[Change], Path],
) -> None:
    count = iter(range(10**6))
    bad = (0.0, -1.0, 65535.0, float("nan"))

    def spoil(stamped: Stamped) -> list[Stamped]:
        if stamped.topic == "/cf1/range/cf2" and (k := next(count)) % 20 == 0:
            stamped.message.range_m = bad[k // 20 % 4]
        return [stamped]

    with count_left_out() as left_out:
        label_and_warn(change_flight(spoil))
    said = "\n".join(left_out.counts)
    assert "that are not finite, or 1e+06 and more" in said
    assert "that are not in (0, 60] m" in said


def test_robot_without_logs_is_omitted_with_a_warning(
    change_flight: Callable[[Change], Path],
) -> None:
    def add_third_robot(stamped: Stamped) -> list[Stamped]:
        if stamped.topic != "/cf1/range/cf2":
            return [stamped]
        return [stamped, Stamped(stamped.time_ns, "/cf1/range/cf3", stamped.message)]

    assert "cf3: no /cf3/attitude and no /cf3/velocity" in label_and_warn(
        change_flight(add_third_robot)
    )


def test_a_calibration_of_another_size_or_lens_is_refused(flight: Path, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(format_camera(replace(AIDECK, width_px=160)))
    with pytest.raises(SettingError, match="is for images of 160x224, those of cf1"):
        label.run(flight, tmp_path / "out.mcap", replace(LENIENT, camera={"cf1": path}))
    path.write_text(format_camera(replace(AIDECK, distortion=(0.1,) * 8)))
    with pytest.raises(SourceError, match="wrong keys distortion"):
        label.run(flight, tmp_path / "out.mcap", replace(LENIENT, camera={"cf1": path}))
    fisheye = tmp_path / "fisheye.mcap"
    with RecordingWriter(fisheye, Provenance("test")) as sink:
        for stamped in read(flight):
            if stamped.topic == "/cf1/camera/calibration":
                stamped.message.distortion_model = "equidistant"
            sink.write(stamped.time_ns, stamped.topic, stamped.message)
    with pytest.raises(RecordingError, match="a lens of model 'equidistant' with 0 coefficients"):
        label.run(fisheye, tmp_path / "out.mcap", LENIENT)


def test_sensor_gap_is_bridged_with_a_warning(change_flight: Callable[[Change], Path]) -> None:
    def drop_velocities(stamped: Stamped) -> list[Stamped]:
        quiet = 10 * SECOND_NS < stamped.time_ns < 13 * SECOND_NS
        return [] if quiet and stamped.topic == "/cf2/velocity" else [stamped]

    assert "cf2 is silent for" in label_and_warn(change_flight(drop_velocities))


def test_a_clock_that_went_back_is_named(flight: Path, tmp_path: Path) -> None:
    path = tmp_path / "back.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for one in read(flight, "/*/attitude", "/*/velocity", "/*/height", "/*/range/*"):
            late = one.topic == "/cf2/velocity" and one.time_ns > 20 * SECOND_NS
            time_ns = one.time_ns - 5 * SECOND_NS * late
            sink.write(time_ns, one.topic, one.message, publish_ns=one.time_ns)
    assert "/cf2/velocity: its clock goes back" in label_and_warn(path)


def test_angles_in_degrees_give_a_warning(change_flight: Callable[[Change], Path]) -> None:
    def convert_to_degrees(stamped: Stamped) -> list[Stamped]:
        if stamped.topic == "/cf1/attitude":
            stamped.message.roll_rad *= 57.3
            stamped.message.pitch_rad *= 57.3
        return [stamped]

    assert "Are they degrees?" in label_and_warn(change_flight(convert_to_degrees))


def test_clocks_an_hour_apart_are_an_error_of_one_line(
    change_flight: Callable[[Change], Path], tmp_path: Path
) -> None:
    def delay(stamped: Stamped) -> list[Stamped]:
        hour = 3600 * SECOND_NS if stamped.topic.startswith("/cf2") else 0
        return [Stamped(stamped.time_ns + hour, stamped.topic, stamped.message)]

    with pytest.raises(
        RecordingError, match=r"share 0\.0 s.*clocks agree\? Try: dmrl align"
    ) as caught:
        label_and_warn(change_flight(delay))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("held", "why"),
    [
        (["attitude"], "estimated: no robot has attitude.*; there are no ranges on"),
        (["attitude", "velocity", "height"], "estimated: there are no ranges on"),
    ],
)
def test_recording_without_ranges_is_refused(
    change_flight: Callable[[Change], Path], held: list[str], why: str
) -> None:
    out = change_flight(lambda s: [s])
    bare = out.with_name("bare.mcap")
    with RecordingWriter(bare, Provenance("test")) as sink:
        for stamped in read(out, *(f"/*/{name}" for name in held)):
            sink.write(stamped.time_ns, stamped.topic, stamped.message)
    with pytest.raises(RecordingError, match=why):
        label.run(bare, out.with_name("out.mcap"), Settings())
