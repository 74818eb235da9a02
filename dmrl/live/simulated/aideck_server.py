"""Simulated AI-deck that sends a flight's images over CPX, in any of the layouts."""

import socket
from contextlib import suppress
from typing import Literal

import numpy as np

from dmrl.errors import SettingError
from dmrl.formats.aideck.cpx import Image
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.formats.aideck.cpx_state import RobotState
from dmrl.geometry.frames import AIDECK, AIDECK_CORNER_PX, AIDECK_SENSOR_PX
from dmrl.images import bayer, codec
from dmrl.live.simulated.flight_source import FlightClock, FlightImages, SimulatedFaults
from dmrl.live.threads import StoppableThread

SentLayout = Literal["plain", "stamped", "streamer", "jpeg"]
"""The layouts of raw images, or plain JPEG."""

POLL_S = 0.05
CAMERA_CLOCK_OFFSET_US = 3_210_000
"""Offset of the camera's clock from the robot's, since its chip starts at another time."""
UART_LATENCY_US = 1_500
"""Latency of a state on its way to the camera."""
JPEG_QUALITY = 90


class SimulatedCamera(StoppableThread):
    """Thread of one simulated camera. Like the deck, it serves one client at a time.

    Parameters
    ----------
    robot
        Robot that carries the camera.
    address
        Host and port to listen at.
    pictures
        Images of its flight. Those whose time passes without a client are skipped.
    clock
        Common clock of the flight.
    faults
        Simulated faults of the robot.
    sends
        Layout of the images.
    seed
        Seed of the dropped images.

    Raises
    ------
    SettingError
        If the port cannot be opened.
    """

    def __init__(
        self,
        robot: str,
        address: tuple[str, int],
        pictures: FlightImages,
        clock: FlightClock,
        faults: SimulatedFaults,
        sends: SentLayout,
        seed: int,
    ) -> None:
        super().__init__(f"fake camera {robot}")
        self.robot, self.sent, self.dropped = robot, 0, 0
        self._address, self._pictures = address, pictures
        self._clock, self._faults, self._sends = clock, faults, sends
        self._chance = np.random.default_rng(seed)
        self._number = 0
        self._listener = self._open_listener()

    def _open_listener(self) -> socket.socket:
        try:
            listener = socket.create_server(self._address)
        except OSError as e:
            raise SettingError(
                f"camera port {self._address[1]}: {e.strerror or e}. Pass another --camera"
            ) from None
        listener.settimeout(POLL_S)
        self._address = (self._address[0], int(listener.getsockname()[1]))
        return listener

    @property
    def port(self) -> int:
        """Port at which it listens."""
        return self._address[1]

    def close(self) -> None:
        """Release the port, if the thread was never started."""
        if self.ident is None:
            self._listener.close()

    def run(self) -> None:
        """Serve one client after the other with images, until stopped."""
        while not self._stop_wanted.is_set():
            if self._faults.is_dead(self._clock.now_s()):
                self._listener.close()
                self._stop_wanted.wait(POLL_S)
                continue
            if self._listener.fileno() < 0:
                self._listener = self._open_listener()
            with suppress(TimeoutError):
                client, _ = self._listener.accept()
                with client, suppress(OSError):
                    client.settimeout(1.0)
                    self._serve_client(client)
        self._listener.close()

    def _serve_client(self, client: socket.socket) -> None:
        for time_s, picture in self._pictures:
            behind_s = self._clock.now_s() - time_s
            if self._faults.is_dead(time_s):
                continue  # nobody took it
            self._number += 1
            if self._clock.flying and behind_s > 1.0:
                continue  # its time passed without a client
            if not self._wait_until(time_s):
                return
            if self._chance.random() < self._faults.drop:
                self.dropped += 1
                continue
            image = self._build_image(picture, time_s)
            client.sendall(pack_image(image, "plain" if self._sends == "jpeg" else self._sends))
            self.sent += 1
        while not self._stop_wanted.wait(POLL_S):
            pass  # landed; the connection stays

    def _wait_until(self, time_s: float) -> bool:
        """Wait for a time of the flight; return False if the robot died or the thread is to end."""
        while not self._stop_wanted.is_set():
            now_s = self._clock.now_s()
            if self._faults.is_dead(now_s):
                return False
            if self._clock.flying and now_s >= time_s:
                return True
            left_s = (time_s - now_s) / self._clock.speed
            self._stop_wanted.wait(min(left_s, POLL_S) if self._clock.flying else POLL_S)
        return False

    def _build_image(self, picture: bytes, time_s: float) -> Image:
        rgb = pad_to_sensor(codec.decode(picture))
        height_px, width_px = rgb.shape[:2]
        if self._sends == "jpeg":
            data = codec.encode_jpeg(rgb, JPEG_QUALITY)
            return Image(width_px, height_px, "jpeg", data)
        robot_us = round(1000 * self._faults.clock_ms(time_s))
        time_us = robot_us + CAMERA_CLOCK_OFFSET_US
        data, layout = bayer.to_bayer(rgb).tobytes(), self._sends
        state = self._build_state(robot_us) if layout == "streamer" else None
        return Image(width_px, height_px, "raw", data, time_us, self._number, state)

    @staticmethod
    def _build_state(robot_us: int) -> RobotState:
        """Build the last state that arrived before the exposure, at a whole millisecond."""
        sent_ms = (robot_us - UART_LATENCY_US) // 1000
        return RobotState(sent_ms, 1000 * sent_ms + UART_LATENCY_US + CAMERA_CLOCK_OFFSET_US)


def pad_to_sensor(rgb: codec.Rgb) -> codec.Rgb:
    """Pad (H, W, 3) of the calibrated area to the whole sensor; other sizes are unchanged."""
    if rgb.shape[:2] != (AIDECK.height_px, AIDECK.width_px):
        return rgb
    width_px, height_px = AIDECK_SENSOR_PX
    left, top = AIDECK_CORNER_PX
    rows = top, height_px - top - AIDECK.height_px
    cols = left, width_px - left - AIDECK.width_px
    return np.pad(rgb, (rows, cols, (0, 0)), mode="edge")
