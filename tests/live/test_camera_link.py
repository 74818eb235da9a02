"""The client of an AI deck: connections, invalid images and exposure times."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.formats.aideck import cpx
from dmrl.formats.aideck.cpx import Image
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.formats.aideck.cpx_log import APP, GAP8, HOST, Packet, pack_packet
from dmrl.formats.aideck.cpx_state import RobotState
from dmrl.live.camera_link import MAX_GARBAGE_BYTES, CameraClient, _ExposureTimes, parse_address
from dmrl.live.queue import ReceivedSample, SampleQueue
from dmrl.live.receive_clocks import HostClock

PATIENCE_S = 100.0
RNG = np.random.default_rng(5)
Start = Callable[[int], tuple[CameraClient, SampleQueue]]
RAW = Image(320, 224, "raw", RNG.bytes(320 * 224))


def wait_until(what: Callable[[], object]) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline, "the condition did not become true"
        time.sleep(0.01)


def add_image(times: _ExposureTimes, image: Image, arrival_ns: int) -> list[int]:
    """Add an image; return the times, nanoseconds, of all images that are known from then on."""
    return [time_ns for _, time_ns, _ in times.add_image(image, arrival_ns)]


class Deck:
    """A camera that sends each client one answer and closes the connection."""

    def __init__(self, *answers: bytes) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._run, args=(answers,), daemon=True)
        self._thread.start()

    def _run(self, answers: tuple[bytes, ...]) -> None:
        for answer in answers:
            client, _ = self._listener.accept()
            with client:
                client.sendall(answer)
        self._listener.close()


@pytest.fixture
def client() -> Iterator[Start]:
    """Return a function that connects a client of cf1 to a port; stop the clients at the end."""
    started: list[CameraClient] = []

    def start(port: int) -> tuple[CameraClient, SampleQueue]:
        feed = SampleQueue()
        started.append(CameraClient("cf1", "127.0.0.1", port, feed, HostClock()))
        started[-1].start()
        return started[-1], feed

    yield start
    for one in started:
        one.stop()
    for one in started:
        one.join(timeout=PATIENCE_S)


def split_items(feed: SampleQueue) -> tuple[list[ReceivedSample], list[str]]:
    """Return the samples and the messages of a queue."""
    items = feed.get_batch(0.0)
    return [i for i in items if isinstance(i, ReceivedSample)], [
        i for i in items if isinstance(i, str)
    ]


def test_images_come_after_their_calibration_over_two_connections(client: Start) -> None:
    deck = Deck(pack_image(RAW), pack_image(RAW) * 2)
    camera, feed = client(deck.port)
    wait_until(lambda: camera.health.received == 3)
    received, said = split_items(feed)
    topics = [item.sample.topic for item in received]
    assert topics == ["/cf1/camera/calibration", *["/cf1/camera/image"] * 3]
    assert camera.health.connections == 2
    assert "closed the connection" in said[0]


def test_closed_port_is_reported_once_and_retried(client: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken_port:
        port = taken_port.getsockname()[1]
    camera, feed = client(port)
    wait_until(lambda: camera.health.state == "refuses connections")
    assert camera.is_alive()
    assert split_items(feed)[1] == [
        f"cf1: camera refuses connections at 127.0.0.1:{port}; trying again"
    ]


def test_garbage_ends_the_connection_and_gives_no_image(client: Start) -> None:
    deck = Deck(RNG.bytes(2 * MAX_GARBAGE_BYTES))
    camera, feed = client(deck.port)
    wait_until(lambda: camera.health.state == "sends no CPX images")
    assert camera.health.received == 0
    assert split_items(feed)[0] == []


def test_invalid_images_are_counted_and_omitted(client: Start) -> None:
    header = cpx.HEADER.pack(cpx.MAGIC, 320, 224, 1, 0, 100)
    wrong = [Packet(GAP8, HOST, APP, data) for data in (header, bytes(100))]
    no_jpeg = Image(320, 224, "jpeg", b"\xff\xd8" + bytes(500))
    deck = Deck(b"".join(map(pack_packet, wrong)) + pack_image(no_jpeg) + pack_image(RAW))
    camera, feed = client(deck.port)
    wait_until(lambda: camera.health.received == 1)
    assert camera.health.broken == 2
    assert len(split_items(feed)[0]) == 2


def test_images_of_another_size_come_without_a_calibration(client: Start) -> None:
    camera, feed = client(Deck(pack_image(Image(16, 16, "raw", bytes(256)))).port)
    wait_until(lambda: camera.health.received == 1)
    received, said = split_items(feed)
    assert [item.sample.topic for item in received] == ["/cf1/camera/image"]
    assert "16 x 16 px, the calibration is for 320 x 224 px" in said[0]


@pytest.mark.parametrize("text", ["", ":5000", "host:", "host:0", "host:70000", "host:x"])
def test_invalid_address_is_refused(text: str) -> None:
    with pytest.raises(SettingError, match="HOST:PORT"):
        parse_address(text)


def test_default_port_of_the_deck_is_used() -> None:
    assert parse_address("192.168.4.1") == ("192.168.4.1", 5000)


def test_exposure_time_uses_the_best_clock_and_never_exceeds_arrival() -> None:
    known: dict[float, int] = {}
    times = _ExposureTimes(known.get)
    # The robot's clock was at 4 ms when the camera's was at 0. The image was taken 1 ms later.
    robot = replace(RAW, time_us=1_000, state=RobotState(robot_ms=4, received_us=0))
    assert robot.robot_time_us == 5_000
    assert add_image(times, robot, 10**9) == []  # waits, because the robot's clock is not known yet
    known[5.0] = 123_000_000
    assert add_image(times, robot, 2 * 10**9) == [123_000_000, 123_000_000]
    own = _ExposureTimes(known.get)
    assert add_image(own, replace(RAW, time_us=1_000_000), 5 * 10**9) == []
    # The image was taken 1 s later but arrives only 0.6 s after the first one.
    assert add_image(own, replace(RAW, time_us=2_000_000), 5_600_000_000) == []
    settled = [4_600_000_000, 5_600_000_000, 6_000_000_000]
    assert add_image(own, replace(RAW, time_us=2_400_000), 6_200_000_000) == settled
    assert add_image(own, replace(RAW, time_us=2_500_000), 6_200_000_000) == [6_100_000_000]
    assert add_image(own, RAW, 7 * 10**9) == [7 * 10**9]  # without any clock, the time of arrival
    assert add_image(_ExposureTimes(known.get), RAW, 10**9) == [10**9]


def test_images_that_wait_for_a_clock_are_posted_at_the_end(client: Start) -> None:
    images = [replace(RAW, time_us=20_000 * k) for k in range(3)]
    deck = Deck(b"".join(pack_image(image, "stamped") for image in images))
    run, feed = client(deck.port)
    wait_until(lambda: run.health.received == 3)
    found = [one for one in feed.get_batch(0.0) if isinstance(one, ReceivedSample)]
    assert [one.sample.message for one in found] == ["CameraCalibration", *["CompressedImage"] * 3]
    assert np.diff([one.sample.time_ns for one in found[1:]]).tolist() == [20_000_000] * 2
