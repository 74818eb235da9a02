"""Recorded CPX stream of an AI-deck: the bytes that came over TCP, unchanged.

Record one with ``nc 192.168.4.1 5000 > flight.cpx``. Its content is described in ``cpx``. Images
get the camera's times if the stream contains them, otherwise nominal ones.
"""

from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.aideck.cpx import Image, ImageReader
from dmrl.formats.aideck.cpx_state import State
from dmrl.formats.base import Content, Format, Options
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import Block
from dmrl.images import codec
from dmrl.images.bayer import rgb_of
from dmrl.samples.flight import in_order
from dmrl.samples.sample import Sample, calibration, image
from dmrl.terminal.progress import say

PIECE_BYTES = 1 << 16
LOOK_BYTES = 1 << 18


def recognises(source: Path) -> bool:
    """Return whether a whole image begins in the first 256 KiB of a file."""
    if not source.is_file() or source.suffix not in (".cpx", ".bin", ".raw", ""):
        return False
    reader = ImageReader()
    with source.open("rb") as stream:
        found = next(reader.feed(stream.read(LOOK_BYTES)), None)
    return found is not None and reader.skipped_bytes < PIECE_BYTES


def content(source: Path, options: Options) -> Content:
    """Load the samples of a stream: images in RGB, and the robot's state if the stream has it.

    Parameters
    ----------
    source
        The file.
    options
        ``robot``, ``rate_hz`` and ``camera``, which must have the size of the images.

    Raises
    ------
    SourceError
        If the stream has no whole image.
    MissingExtra
        If images are raw and OpenCV is not installed.
    """
    if not source.is_file():
        raise SourceError(f"{source} is not a file. Pass a recorded stream")
    times, states, reader = [], [], ImageReader()
    for found in _images(source, reader):
        times.append(found.time_us)
        states.append(found.state)
    if not times:
        raise SourceError(f"{source} has no whole image of a CPX stream. Pass another file")
    if reader.broken or reader.skipped_bytes:
        say(
            f"{source}: {reader.broken} images are broken or cut short and "
            f"{reader.skipped_bytes} bytes belong to no packet; left out"
        )
    time_ns = _times_ns(times, options.rate_hz)
    pictures = _pictures(source, time_ns, options)
    told = [state for state in states if state is not None]
    return Content(in_order([pictures, *_states(told, options, source)]))


def _images(source: Path, reader: ImageReader) -> Iterator[Image]:
    with source.open("rb") as stream:
        while data := stream.read(PIECE_BYTES):
            yield from reader.feed(data)
    reader.finish()


def _times_ns(times_us: Sequence[int | None], rate_hz: float) -> list[int]:
    """Return the camera's times, or nominal ones unless every image has one."""
    if any(time is None for time in times_us):
        return [round(k * 1e9 / rate_hz) for k in range(len(times_us))]
    return list(accumulate((1000 * (time or 0) for time in times_us), max))


def _pictures(source: Path, time_ns: Sequence[int], options: Options) -> Iterator[Sample]:
    for k, (moment, found) in enumerate(zip(time_ns, _images(source, ImageReader()), strict=True)):
        if k == 0 and options.camera is not None:
            yield calibration(moment, options.robot, options.camera)
        if found.encoding == "jpeg":
            yield image(moment, options.robot, found.data, "jpeg")
            continue
        raw = np.frombuffer(found.data, np.uint8).reshape(found.height_px, found.width_px)
        yield image(moment, options.robot, codec.encode_png(rgb_of(raw)), "png")


def _states(states: Sequence[State], options: Options, source: Path) -> list[log_variables.Stream]:
    """Build the streams of the robot's states, each state once."""
    fresh = list({state.received_us: state for state in states}.values())
    if not fresh:
        return []
    columns = {
        f"stateEstimate.{name}": np.array(values)
        for names, part in (
            ("x y z", [s.position_m for s in fresh]),
            ("vx vy vz", [s.velocity_mps for s in fresh]),
            ("qx qy qz qw", [s.quaternion_xyzw for s in fresh]),
        )
        for name, values in zip(names.split(), zip(*part, strict=True), strict=True)
    }
    turning = np.degrees([s.turning_radps for s in fresh]).T
    columns |= {f"gyro.{axis}": turning[k] for k, axis in enumerate("xyz")}
    time_ns = np.array([1000 * s.received_us for s in fresh], np.int64)
    block = Block("cpx_state", time_ns, columns)
    return log_variables.streams(options.robot, [block], options.names, source)


FORMAT = Format("aideck-stream", "a recorded CPX stream", recognises, content)
