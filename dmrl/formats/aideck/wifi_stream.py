"""A recorded CPX stream of an AI-deck: the bytes as they came over TCP, nothing added.

``nc 192.168.4.1 5000 > flight.cpx`` makes one. See ``cpx`` for what is in it. Where the
camera sends its time with the pictures, that is their time; bare streams get nominal ones.
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
    """Whether images, whole and unbroken, begin in the first 256 KiB of a file."""
    if not source.is_file() or source.suffix not in (".cpx", ".bin", ".raw", ""):
        return False
    reader = ImageReader()
    with source.open("rb") as stream:
        found = next(reader.feed(stream.read(LOOK_BYTES)), None)
    return found is not None and reader.skipped_bytes < PIECE_BYTES


def content(source: Path, options: Options) -> Content:
    """Samples of a stream: pictures in RGB, and the robot's state where it is in the stream.

    Parameters
    ----------
    source
        The file.
    options
        ``robot``, ``rate_hz`` and ``camera``, which must be of the size that is streamed.

    Raises
    ------
    SourceError
        If there is no whole picture in it.
    MissingExtra
        If pictures are raw and OpenCV is not installed.
    """
    if not source.is_file():
        raise SourceError(f"{source} is no file. Name the bytes of a stream")
    times, states, reader = [], [], ImageReader()
    for found in _images(source, reader):
        times.append(found.time_us)
        states.append(found.state)
    if not times:
        raise SourceError(f"{source} holds no whole picture of a CPX stream. Name another file")
    if reader.broken or reader.skipped_bytes:
        say(
            f"{source}: {reader.broken} pictures are broken or cut short and "
            f"{reader.skipped_bytes} bytes belong to nothing; left out"
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
    """The camera's times, or nominal ones where it does not tell every picture's."""
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
    """What the robot told its camera, each state once."""
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
