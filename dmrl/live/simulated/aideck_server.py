"""A simulated AI-deck: a flight's pictures over CPX, in any of the layouts."""

import socket
import threading
from contextlib import suppress
from typing import Literal

import numpy as np

from dmrl.errors import SettingError
from dmrl.formats.aideck.cpx import Image
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.formats.aideck.cpx_state import State
from dmrl.geometry.frames import AIDECK, AIDECK_CORNER_PX, AIDECK_SENSOR_PX
from dmrl.images import bayer, codec
from dmrl.live.simulated.flight_source import Faults, FlightClock, Pictures

Sends = Literal["plain", "stamped", "streamer", "jpeg"]
"""The layouts of raw images, or plain JPEG."""

POLL_S = 0.05
CAMERA_BOOT_US = 3_210_000
"""What the camera's clock shows more than the robot's: its chip starts at another time."""
UART_US = 1_500
"""How long a state takes to the camera."""
JPEG_QUALITY = 90


class FakeCamera(threading.Thread):
    """One camera, from now until stopped. Serves one client at a time, as the deck does.

    Parameters
    ----------
    robot
        That carries it.
    address
        Host and port to listen at.
    pictures
        Of its flight; those whose time passes while nobody listens are gone.
    clock
        Common time of the flight.
    faults
        What goes wrong with the robot.
    sends
        In which form.
    seed
        Which images are dropped.

    Raises
    ------
    SettingError
        If the port cannot be had.
    """

    def __init__(
        self,
        robot: str,
        address: tuple[str, int],
        pictures: Pictures,
        clock: FlightClock,
        faults: Faults,
        sends: Sends,
        seed: int,
    ) -> None:
        super().__init__(name=f"fake camera {robot}", daemon=True)
        self.robot, self.sent, self.dropped = robot, 0, 0
        self._address, self._pictures = address, pictures
        self._clock, self._faults, self._sends = clock, faults, sends
        self._chance = np.random.default_rng(seed)
        self._stop_wanted = threading.Event()
        self._number = 0
        self._listener = self._listen()

    def _listen(self) -> socket.socket:
        try:
            listener = socket.create_server(self._address)
        except OSError as e:
            raise SettingError(
                f"camera port {self._address[1]}: {e.strerror or e}. Name another --camera"
            ) from None
        listener.settimeout(POLL_S)
        self._address = (self._address[0], int(listener.getsockname()[1]))
        return listener

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._address[1]

    def stop(self) -> None:
        """Ask it to end; `join` waits for that."""
        self._stop_wanted.set()

    def close(self) -> None:
        """Give the port back, if it was never started."""
        if self.ident is None:
            self._listener.close()

    def run(self) -> None:
        """Wait for a client and send it images, and again."""
        while not self._stop_wanted.is_set():
            if self._faults.dead(self._clock.now_s()):
                self._listener.close()
                self._stop_wanted.wait(POLL_S)
                continue
            if self._listener.fileno() < 0:
                self._listener = self._listen()
            with suppress(TimeoutError):
                client, _ = self._listener.accept()
                with client, suppress(OSError):
                    client.settimeout(1.0)
                    self._serve(client)
        self._listener.close()

    def _serve(self, client: socket.socket) -> None:
        for time_s, picture in self._pictures:
            behind_s = self._clock.now_s() - time_s
            self._number += 1
            if self._clock.flying and behind_s > 1.0:
                continue  # its time passed while nobody listened
            if not self._wait_until(time_s):
                return
            if self._chance.random() < self._faults.drop:
                self.dropped += 1
                continue
            image = self._image(picture, time_s)
            client.sendall(pack_image(image, "plain" if self._sends == "jpeg" else self._sends))
            self.sent += 1
        while not self._stop_wanted.wait(POLL_S):
            pass  # landed; the connection stays

    def _wait_until(self, time_s: float) -> bool:
        """Whether the flight reached a time; False if the robot died or all is to end."""
        while not self._stop_wanted.is_set():
            now_s = self._clock.now_s()
            if self._faults.dead(now_s):
                return False
            if self._clock.flying and now_s >= time_s:
                return True
            left_s = (time_s - now_s) / self._clock.speed
            self._stop_wanted.wait(min(left_s, POLL_S) if self._clock.flying else POLL_S)
        return False

    def _image(self, picture: bytes, time_s: float) -> Image:
        rgb = whole_sensor(codec.decode(picture))
        height_px, width_px = rgb.shape[:2]
        if self._sends == "jpeg":
            data = codec.encode_jpeg(rgb, JPEG_QUALITY)
            return Image(width_px, height_px, "jpeg", data)
        robot_us = round(1000 * self._faults.clock_ms(time_s))
        time_us = robot_us + CAMERA_BOOT_US
        data, layout = bayer.mosaic(rgb).tobytes(), self._sends
        state = self._state(robot_us) if layout == "streamer" else None
        return Image(width_px, height_px, "raw", data, time_us, self._number, state)

    @staticmethod
    def _state(robot_us: int) -> State:
        """The last state that came before an image was taken: of a whole millisecond."""
        sent_ms = (robot_us - UART_US) // 1000
        return State(sent_ms, 1000 * sent_ms + UART_US + CAMERA_BOOT_US)


def whole_sensor(rgb: codec.Rgb) -> codec.Rgb:
    """What the whole sensor saw of (H, W, 3), with the cut-off border made up; or as it was."""
    if rgb.shape[:2] != (AIDECK.height_px, AIDECK.width_px):
        return rgb
    width_px, height_px = AIDECK_SENSOR_PX
    left, top = AIDECK_CORNER_PX
    rows = top, height_px - top - AIDECK.height_px
    cols = left, width_px - left - AIDECK.width_px
    return np.pad(rgb, (rows, cols, (0, 0)), mode="edge")
