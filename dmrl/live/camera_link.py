"""Camera of an AI-deck over WiFi: images as samples, with automatic reconnection."""

import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from dmrl.errors import SettingError, SourceError
from dmrl.formats.aideck.cpx import DEFAULT_PORT, Image, ImageReader
from dmrl.formats.timestamps import SteadyRateFilter
from dmrl.geometry.frames import AIDECK, AIDECK_SENSOR_PX, Camera
from dmrl.live.image_assembly import ColourMode, StoredFormat, encode_image
from dmrl.live.queue import LinkStatus, ReceivedSample, SampleQueue
from dmrl.live.receive_clocks import HostClock, SenderClock
from dmrl.live.threads import StoppableThread
from dmrl.samples.sample import build_calibration
from dmrl.samples.sample import build_image as image_sample

NS_PER_US = 1_000
CONNECT_TIMEOUT_S = 3.0
RECEIVE_TIMEOUT_S = 3.0
RETRY_DELAY_S = 1.0
READ_BYTES = 1 << 16
MAX_GARBAGE_BYTES = 1 << 20
"""Bytes without an image after which a connection is no image stream."""

FRAME_IDS = 256
PERIOD_WEIGHT = 0.1
"""Weight of a new interval in the mean of the last ones."""

RobotTime = Callable[[float], int | None]


def parse_address(text: str) -> tuple[str, int]:
    """Parse host and port of "HOST:PORT", or "HOST" for the AI-deck's own port.

    Raises
    ------
    SettingError
        If the text is neither.
    """
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = text, str(DEFAULT_PORT)
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise SettingError(f"camera={text} is no HOST:PORT. Use camera=192.168.4.1:{DEFAULT_PORT}")
    return host, int(port)


TimedImage = tuple[Image, int, int]
"""An image, its time of exposure and of arrival on this computer's clock, nanoseconds."""


@dataclass(slots=True)
class _ExposureTimes:
    """Times of exposure of one connection's images, on this computer's clock.

    The best available source is used: the robot's time of an image, else the camera's, else the
    time of arrival. Images with a time wait until the clocks have settled.
    """

    robot_time: RobotTime
    clock: SenderClock = field(default_factory=SenderClock)
    steady: SteadyRateFilter = field(default_factory=SteadyRateFilter)
    held: list[tuple[Image, int]] = field(default_factory=list)

    def add_image(self, image: Image, arrival_ns: int) -> Iterator[TimedImage]:
        """Yield the images whose times are known by now."""
        if image.time_us is not None:
            self.clock.add_sample(image.time_us * NS_PER_US, arrival_ns)
        self.held.append((image, arrival_ns))
        if image.time_us is None or self.clock.settled:
            yield from self.flush()

    def flush(self) -> Iterator[TimedImage]:
        """Yield the images that wait for the clocks."""
        held, self.held = self.held, []
        for image, arrival_ns in held:
            yield image, self._find_time_ns(image, arrival_ns), arrival_ns

    def _find_time_ns(self, image: Image, arrival_ns: int) -> int:
        if image.robot_time_us is not None:
            known = self.robot_time(image.robot_time_us / 1000)
            if known is not None:
                return known
        if image.time_us is None:
            return self.steady(arrival_ns)
        return min(self.clock.to_host_ns(image.time_us * NS_PER_US), arrival_ns)


class FrameCount:
    """Count of lost images by the camera's own counter of 8 bits, over pauses and reconnections.

    A pause of more than 255 images is resolved by its length. A camera that restarted begins at an
    earlier time; nothing is known of its images before that.
    """

    def __init__(self) -> None:
        self._last: Image | None = None
        self._seen_ns = 0
        self._period_ns = 0.0

    def add_image(self, image: Image, arrival_ns: int) -> int:
        """Count an image; return the number lost since the one before."""
        last, waited_ns = self._last, arrival_ns - self._seen_ns
        self._last, self._seen_ns = image, arrival_ns
        if last is None or last.frame_id is None or image.frame_id is None:
            return 0
        if image.time_us is not None and last.time_us is not None and image.time_us < last.time_us:
            return 0
        step = (image.frame_id - last.frame_id) % FRAME_IDS
        if self._period_ns:
            step += max(round((waited_ns / self._period_ns - step) / FRAME_IDS), 0) * FRAME_IDS
        if step == 1:  # of images that follow each other; arrivals vary
            change = waited_ns - self._period_ns
            self._period_ns += change * (PERIOD_WEIGHT if self._period_ns else 1.0)
        return max(step - 1, 0)


class CameraClient(StoppableThread):
    """Thread that receives the images of one camera until it is stopped.

    Parameters
    ----------
    robot
        Robot that carries the camera.
    host, port
        Address of the camera.
    feed
        Queue for the samples: the calibration first, then images.
    now
        This computer's clock.
    colours
        Whether raw images come from a sensor with colour filters.
    stored
        See `encode_image`.
    camera
        Its calibration; None: the AI-deck's, if the size matches.
    robot_time
        Convert a time of the robot's clock, milliseconds, to this computer's; None while unknown.
    """

    def __init__(
        self,
        robot: str,
        host: str,
        port: int,
        feed: SampleQueue,
        now: HostClock,
        *,
        colours: ColourMode = "colour",
        stored: StoredFormat = "png",
        camera: Camera | None = None,
        robot_time: RobotTime = lambda _: None,
    ) -> None:
        super().__init__(f"camera {robot}")
        self.health = LinkStatus(f"{robot} camera")
        self.robot, self._where = robot, (host, port)
        self._feed, self._now = feed, now
        self._form = colours, stored
        self._camera, self._robot_time = camera, robot_time
        self._size_px: tuple[int, int] | None = None
        self._warned: set[str] = set()
        self._frames = FrameCount()

    def run(self) -> None:
        """Connect and post images, again after each loss, until stopped."""
        while not self._stop_wanted.is_set():
            why = self._run_connection()
            if self._stop_wanted.is_set():
                break
            if self.health.state != why:
                host, port = self._where
                self._feed.post_message(
                    f"{self.robot}: camera {why} at {host}:{port}; trying again"
                )
            self.health.state = why
            self._stop_wanted.wait(RETRY_DELAY_S)
        self.health.state = "stopped"

    def _run_connection(self) -> str:
        """Receive until the connection ends. Return the reason."""
        try:
            with socket.create_connection(self._where, timeout=CONNECT_TIMEOUT_S) as connection:
                connection.settimeout(0.2)
                return self._receive_images(connection)
        except ConnectionRefusedError:
            return "refuses connections"
        except TimeoutError:
            return "does not answer"
        except OSError as e:
            return f"cannot be reached ({e.strerror or e})"

    def _receive_images(self, connection: socket.socket) -> str:
        times = _ExposureTimes(self._robot_time)
        self.health.connections += 1
        try:
            return self._receive_until_end(connection, times)
        finally:
            self._post_images(times.flush())

    def _receive_until_end(self, connection: socket.socket, times: _ExposureTimes) -> str:
        reader = ImageReader()
        broken, last_s, useless_bytes = 0, time.monotonic(), 0
        while not self._stop_wanted.is_set():
            try:
                data = connection.recv(READ_BYTES)
            except TimeoutError:
                if time.monotonic() - last_s > RECEIVE_TIMEOUT_S:
                    return "is silent"
                continue
            if not data:
                return "closed the connection"
            last_s, arrival_ns = time.monotonic(), self._now()
            useless_bytes += len(data)
            for image in reader.feed(data):
                self.health.state, useless_bytes = "connected", 0
                self.health.lost += self._frames.add_image(image, arrival_ns)
                self._post_images(times.add_image(image, arrival_ns))
            self.health.broken += reader.broken - broken
            broken = reader.broken
            if useless_bytes > MAX_GARBAGE_BYTES:
                return "sends no CPX images"
        return "stopped"

    def _post_images(self, images: Iterator[TimedImage]) -> None:
        for image in images:
            self._post_image(*image)

    def _post_image(self, image: Image, time_ns: int, arrival_ns: int) -> None:
        try:
            data, kind = encode_image(image, *self._form)
        except SourceError as e:
            self.health.broken += 1
            self._warn_once(f"{self.robot}: {e}")
            return
        self._post_calibration((image.width_px, image.height_px), time_ns, arrival_ns)
        self.health.last_arrival_ns = arrival_ns
        sample = image_sample(time_ns, self.robot, data, kind)
        self._feed.post_sample(ReceivedSample(sample, arrival_ns))
        self.health.received += 1

    def _post_calibration(self, sent_px: tuple[int, int], time_ns: int, arrival_ns: int) -> None:
        """Post the calibration before the first image, if it matches the image size."""
        size_px = (AIDECK.width_px, AIDECK.height_px) if sent_px == AIDECK_SENSOR_PX else sent_px
        if size_px == self._size_px:
            return
        if self._size_px is not None:
            self._warn_once(f"{self.robot}: images are {size_px} px now, {self._size_px} px before")
        self._size_px = size_px
        camera = self._camera or AIDECK
        if (camera.width_px, camera.height_px) == size_px:
            self._feed.post_sample(
                ReceivedSample(build_calibration(time_ns, self.robot, camera), arrival_ns)
            )
            return
        self._warn_once(
            f"{self.robot}: images are {size_px[0]} x {size_px[1]} px, the calibration is for "
            f"{camera.width_px} x {camera.height_px} px and left out; labels will need one"
        )

    def _warn_once(self, line: str) -> None:
        if line not in self._warned:
            self._warned.add(line)
            self._feed.post_message(line)
