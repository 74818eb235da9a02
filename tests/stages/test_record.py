"""`dmrl record` with simulated drones: losses, restarts, signals and errors."""

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.errors import MissingExtra, MissingTopic, OutputError, RecordingError, SettingError
from dmrl.images.codec import decode
from dmrl.ingest.live_session import Result
from dmrl.live import crazyflie_link
from dmrl.live.robot_options import RobotOptions, parse_robot
from dmrl.recording import read, read_table, recover
from dmrl.simulation import drone_fleet
from dmrl.simulation.drone_fleet import Fleet
from dmrl.stages import fake_drone, fly, record

pytest.importorskip("cflib", reason="cflib (extra record) is not installed")

# Threads of cflib may use a link that another of its threads has just closed.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")

PATIENCE_S = 100.0
PICTURES_HZ, FIRST_PICTURE_S = 2.0, 0.25
ANY = ("udp://127.0.0.1:0", "udp://127.0.0.1:0")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of two robots over 3 s with images."""
    path = tmp_path_factory.mktemp("flight") / "sim.mcap"
    pictures = {"camera": True, "camera_rate_hz": PICTURES_HZ}
    fly.run(path, fly.Settings(duration_s=3.0, noise="ideal", seed=3, **pictures))
    return path


def list_robots(fleet: Fleet) -> list[RobotOptions]:
    """Return the addresses of the robots of a simulated fleet."""
    ports = {camera.robot: camera.port for camera in fleet.cameras}
    return [
        RobotOptions(
            d.robot,
            f"udp://127.0.0.1:{d.port}",
            ("127.0.0.1", ports[d.robot]) if d.robot in ports else None,
        )
        for d in fleet.drones
    ]


def record_until(out: Path, fleet: Fleet, until: Callable[[], bool]) -> Result:
    """Record until a condition holds, and another 1.5 s."""
    ended = threading.Event()

    def watch() -> None:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and not until():
            time.sleep(0.02)
        time.sleep(1.5)  # for packets that are still on their way on a busy machine
        ended.set()

    watcher = threading.Thread(target=watch)
    watcher.start()
    result = record.run(out, list_robots(fleet), record.Settings(), ended=ended)
    watcher.join()
    return result


def count_packets(result: Result) -> dict[str, tuple[int, int, int]]:
    """Return the received, lost and broken packets of each source."""
    return {h.source: (h.received, h.lost, h.broken) for h in result.healths}


@pytest.mark.heavy
def test_every_packet_sent_is_recorded(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    # The clock of the drones wraps one second after take-off.
    settings = fake_drone.Settings(sends="streamer", boot_ms=float((1 << 24) - 1000))
    with drone_fleet.fleet(flight, ANY, (0, 0), settings) as fleet:
        result = record_until(out, fleet, lambda: fleet.clock.landed)
    got = count_packets(result)
    for drone in fleet.drones:
        received, lost, broken = got[drone.robot]
        assert lost == broken == 0
        assert received == drone.sent > 500
        assert drone.setpoints == 0
    for camera in fleet.cameras:
        assert got[f"{camera.robot} camera"] == (camera.sent, 0, 0)
    starts = {robot: assert_equals_flight(flight, out, robot) for robot in ("cf1", "cf2")}
    assert abs(starts["cf1"] - starts["cf2"]) < 20e6


def assert_equals_flight(flight: Path, out: Path, robot: str) -> float:
    """Assert that values, images and times equal the flight; return the time of take-off, ns."""
    fields = ("roll_rad", "pitch_rad", "yaw_rate_radps")
    flown, got = (read_table(p, f"/{robot}/attitude", fields=fields) for p in (flight, out))
    values, expected = (np.column_stack([t[f].to_numpy() for f in fields]) for t in (got, flown))
    first = int(np.abs(expected[:, :2] - values[0, :2]).sum(axis=1).argmin())
    assert np.allclose(values, expected[first : first + len(values)], atol=(1e-6, 1e-6, 0.02))
    times = got["log_time"].to_numpy()
    assert np.abs(np.diff(times) - 10e6).max() < 0.1e6
    start_ns = float(times[0]) - 10e6 * first
    pictures = [decode(m.message.data).astype(int) for m in read(flight, f"/{robot}/camera/image")]
    for stamped in read(out, f"/{robot}/camera/image"):
        # The time is on the drone's clock, up to the 1.5 ms that a state takes to the camera.
        number = ((stamped.time_ns - start_ns) * 1e-9 - FIRST_PICTURE_S) * PICTURES_HZ
        assert abs(number - round(number)) < 0.01 * PICTURES_HZ
        assert np.abs(decode(stamped.message.data) - pictures[round(number)]).mean() < 8
    return start_ns


@pytest.mark.heavy
def test_simulated_drones_wait_until_all_packets_are_received(flight: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_port:
        any_port.bind(("127.0.0.1", 0))
        uri = f"udp://127.0.0.1:{any_port.getsockname()[1]}"
    ended, results = threading.Event(), []

    def listen() -> None:
        out = tmp_path / "out.mcap"
        results.append(record.run(out, [RobotOptions("cf1", uri)], record.Settings(), ended=ended))

    recorder = threading.Thread(target=listen)
    recorder.start()
    fleet = fake_drone.run(flight, [uri], [], fake_drone.Settings())
    # The recorder did not disconnect, so the drones waited.
    assert fleet.clock.now_s() >= fleet.clock.end_s + fake_drone.LINGER_S
    ended.set()
    recorder.join()
    (drone,) = fleet.drones
    assert results[0].healths[0].received == drone.sent > 500


@pytest.mark.heavy
def test_dropped_packets_are_counted_and_a_dead_drone_does_not_stop_others(
    flight: Path, tmp_path: Path
) -> None:
    settings = fake_drone.Settings(drop=0.05, dies=("cf2=1",), sends="stamped")
    with drone_fleet.fleet(flight, ANY, (0,), settings) as fleet:
        result = record_until(tmp_path / "out.mcap", fleet, lambda: fleet.clock.landed)
    cf1, cf2 = fleet.drones
    received, lost, _ = count_packets(result)["cf1"]
    assert received == cf1.sent > 500
    # Packets that are dropped before the first or after the last of a block cannot be counted.
    assert cf1.dropped - 3 <= lost <= cf1.dropped and cf1.dropped > 10
    assert count_packets(result)["cf2"][0] == cf2.sent
    assert result.messages["/cf1/attitude"] > 250 and result.messages["/cf2/attitude"] < 150


@pytest.mark.heavy
def test_undecodable_packet_restarts_the_connection_only(
    flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    samples, packets = crazyflie_link.LogDecoder.iter_samples, count()

    def fail_once(self: crazyflie_link.LogDecoder, *packet: Any) -> Any:
        if next(packets) == 20:
            raise ValueError("no such number")
        return samples(self, *packet)

    monkeypatch.setattr(crazyflie_link, "RETRY_DELAY_S", 0.1)
    monkeypatch.setattr(crazyflie_link.LogDecoder, "iter_samples", fail_once)
    with drone_fleet.fleet(flight, ANY[:1], (), fake_drone.Settings(speed=0.5)) as fleet:
        result = record_until(tmp_path / "out.mcap", fleet, lambda: fleet.clock.landed)
    said = "cf1: a packet could not be read (ValueError('no such number')) at udp://"
    assert said in capsys.readouterr().err
    assert result.healths[0].connections >= 2 and result.messages["/cf1/attitude"] > 50


@pytest.mark.heavy
def test_restarted_drone_is_reconnected(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, seconds in {
        "RECEIVE_TIMEOUT_S": 1.0,
        "FIRST_ANSWER_TIMEOUT_S": 0.5,
        "RETRY_DELAY_S": 0.1,
    }.items():
        monkeypatch.setattr(crazyflie_link, name, seconds)
    settings = fake_drone.Settings(dies=("cf1=0.5:0.8",), speed=0.3)
    with drone_fleet.fleet(flight, ANY[:1], (), settings) as fleet:
        (drone,) = fleet.drones
        result = record_until(tmp_path / "out.mcap", fleet, lambda: drone.sent > 160)
    assert result.healths[0].connections >= 2
    times = read_table(tmp_path / "out.mcap", "/cf1/attitude", fields=[])["log_time"].to_numpy()
    assert (np.diff(times) > 0).all()


def recover_attitudes(partial: Path, mended: Path) -> int:
    """Recover a partial recording; return its number of attitudes of cf1."""
    mended.unlink(missing_ok=True)
    try:
        recover(partial, mended)
        return sum(1 for _ in read(mended, "/cf1/attitude"))
    except (RecordingError, MissingTopic):
        return 0


@pytest.mark.heavy
def test_killed_session_is_recovered_up_to_its_last_second(flight: Path, tmp_path: Path) -> None:
    out, mended = tmp_path / "out.mcap", tmp_path / "mended.mcap"
    partial = tmp_path / "out.mcap.partial"
    with drone_fleet.fleet(flight, ANY, (0, 0), fake_drone.Settings()) as fleet:
        named = [
            f"--robot={r.name}={r.uri},camera={r.camera[0]}:{r.camera[1]}"
            for r in list_robots(fleet)
            if r.camera
        ]
        command = [sys.executable, "-m", "dmrl.cli", "record", str(out), *named]
        with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
            deadline = time.monotonic() + PATIENCE_S
            # Wait for content instead of a time, because the progress depends on the machine.
            while recover_attitudes(partial, mended) < 100 and time.monotonic() < deadline:
                time.sleep(0.2)
            process.send_signal(signal.SIGKILL)
    assert not out.exists()
    assert recover_attitudes(partial, mended) >= 100  # of 290
    with pytest.raises(OutputError, match="cut off\\. Bring it back with dmrl recover"):
        record.run(out, [RobotOptions("cf1", "udp://127.0.0.1:9")], record.Settings())


@pytest.mark.heavy
def test_ctrl_c_leaves_a_whole_recording(flight: Path, tmp_path: Path) -> None:
    with drone_fleet.fleet(flight, ANY[:1], (), fake_drone.Settings()) as fleet:
        (drone,) = fleet.drones

        def interrupt() -> None:
            while drone.sent < 150:
                time.sleep(0.02)
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        out = tmp_path / "out.mcap"
        result = record.run(out, list_robots(fleet), record.Settings(duration_s=PATIENCE_S))
    assert sum(1 for _ in read(out, "/cf1/attitude")) == result.messages["/cf1/attitude"] >= 70


def test_unreachable_robots_leave_no_recording(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    nobody = [RobotOptions("cf1", "udp://127.0.0.1:9")]
    with pytest.raises(RecordingError, match=r"no data for .* \(cf1 at udp://127.0.0.1:9"):
        record.run(out, nobody, record.Settings(duration_s=0.5))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("cf1", "not NAME=URI"),
        ("c/f=udp://127.0.0.1:1", "not NAME=URI"),
        ("cf1=udp://127.0.0.1:1,kamera=1", "no option kamera"),
        ("cf1=udp://127.0.0.1:1,camera=h:x", "HOST:PORT"),
    ],
)
def test_a_robot_that_cannot_be_understood_is_refused(text: str, why: str) -> None:
    with pytest.raises(SettingError, match=why):
        parse_robot(text)


@pytest.mark.parametrize("uri", ["cf1", "foo://bar", "udp://127.0.0.1", "udp://h:99999"])
def test_an_address_of_no_driver_is_refused(uri: str, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="no address of a Crazyflie"):
        record.run(tmp_path / "out.mcap", [RobotOptions("cf1", uri)], record.Settings())


def test_two_robots_of_one_name_are_refused(tmp_path: Path) -> None:
    twice = [RobotOptions("cf1", "udp://127.0.0.1:1"), RobotOptions("cf1", "udp://127.0.0.1:2")]
    with pytest.raises(SettingError, match="two robots with the name cf1"):
        record.run(tmp_path / "out.mcap", twice, record.Settings())


def test_missing_cflib_error_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "cflib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cflib", None)
    with pytest.raises(MissingExtra, match=re.escape("pip install 'dmrl[record]'")):
        record.run(
            tmp_path / "out.mcap", [RobotOptions("cf1", "udp://127.0.0.1:1")], record.Settings()
        )


@pytest.mark.parametrize(
    ("uris", "cameras", "settings", "why"),
    [
        (("udp://127.0.0.1:0",) * 3, (), {}, "3 --uri and 0 --camera for 2 robots"),
        (("radio://0",), (), {}, "write udp://HOST:PORT"),
        (("udp://127.0.0.1:0",), (70000,), {}, "--camera 70000"),
        (("udp://127.0.0.1:0",), (), {"dies": ("cf9=3",)}, "--dies cf9=3"),
    ],
)
@pytest.mark.heavy
def test_invalid_fleet_is_refused(
    flight: Path, uris: tuple[str, ...], cameras: tuple[int, ...], settings: dict, why: str
) -> None:
    with (
        pytest.raises(SettingError, match=why),
        drone_fleet.fleet(flight, uris, cameras, fake_drone.Settings(**settings)),
    ):
        pass


def test_without_opencv_colours_are_refused_before_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with_camera = [RobotOptions("cf1", "udp://127.0.0.1:1", ("127.0.0.1", 2))]
    with pytest.raises(MissingExtra, match=re.escape("pip install 'dmrl[record]'")):
        record.run(tmp_path / "out.mcap", with_camera, record.Settings())
    assert not list(tmp_path.iterdir())
