"""Simulated drones send the values and images of a recorded flight."""

import socket
import time

import numpy as np

from dmrl.formats.aideck.cpx import Image, ImageReader
from dmrl.images.codec import encode_png
from dmrl.live.simulated.aideck_server import CAMERA_CLOCK_OFFSET_US, SimulatedCamera
from dmrl.live.simulated.flight_source import FlightClock, SimulatedFaults, SimulatedVariable


def test_blocks_at_the_pace_of_the_flight_send_every_value_once() -> None:
    time_s = np.arange(2000) * 0.01
    faults, variable = SimulatedFaults(), SimulatedVariable("float", (time_s, np.arange(2000.0)))
    due_s = [faults.time_at_clock(faults.boot_ms + 10 * k, 0.01 * k + 0.0037) for k in range(2000)]
    assert [variable.value_at(moment) for moment in due_s] == list(range(2000))


def test_a_camera_sends_no_image_of_its_dead_time() -> None:
    clock, faults = FlightClock(1.0, 9.0), SimulatedFaults(dead_s=(0.5, 0.9))
    clock.take_off()
    clock._start_s = time.monotonic() - 1.0
    picture = encode_png(np.zeros((24, 32, 3), np.uint8))
    pictures = iter([(0.6, picture), (0.8, picture), (0.95, picture)])
    sends = pictures, clock, faults, "stamped", 0
    camera = SimulatedCamera("cf1", ("127.0.0.1", 0), *sends)
    camera.start()
    got: list[Image] = []
    with socket.create_connection(("127.0.0.1", camera.port)) as client:
        client.settimeout(10.0)
        reader = ImageReader()
        while not got:
            got += reader.feed(client.recv(1 << 16))
    camera.stop()
    camera.join()
    assert got[0].time_us == 1000 * 12_390 + CAMERA_CLOCK_OFFSET_US
    assert camera.sent == 1
