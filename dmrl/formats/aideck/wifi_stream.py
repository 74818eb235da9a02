"""Recorded CPX stream of an AI-deck: the bytes that came over TCP, unchanged.

Record one with ``nc 192.168.4.1 5000 > flight.cpx``. Its content is described in ``cpx``. Images
get the camera's times if the stream contains them, otherwise nominal ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.aideck.cpx import Image, ImageReader
from dmrl.formats.aideck.cpx_state import RobotState
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.clocks import settle_times
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import LogBlock
from dmrl.formats.files.pictures import PictureConverter
from dmrl.images.bayer import demosaic
from dmrl.samples.flight import merge_by_time
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out

READ_BYTES = 1 << 16
SNIFF_BYTES = 1 << 18
WRAP_US = 1 << 32


def can_read(source: Path) -> bool:
    """Return whether a whole image begins in the first 256 KiB of a file."""
    if not source.is_file() or source.suffix not in (".cpx", ".bin", ".raw", ""):
        return False
    reader = ImageReader()
    with source.open("rb") as stream:
        found = next(reader.feed(stream.read(SNIFF_BYTES)), None)
    return found is not None and reader.skipped_bytes < READ_BYTES


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a stream: images in RGB, and the robot's state if the stream has it.

    Parameters
    ----------
    source
        The file.
    options
        ``robot``, ``rate_hz``, and those of `PictureConverter`.

    Raises
    ------
    SourceError
        If the stream has no whole image.
    MissingExtra
        If images are raw and OpenCV is not installed.
    """
    if not source.is_file():
        raise SourceError(f"{source} is not a file. Pass a recorded stream")
    times, states, encodings, reader = [], [], set(), ImageReader()
    for found in _iter_images(source, reader):
        times.append(found.time_us)
        states.append(found.state)
        encodings.add(found.encoding)
    if not times:
        raise SourceError(f"{source} has no whole image of a CPX stream. Pass another file")
    if encodings == {"raw"}:
        options.refuse("raw", f"has no effect: the images of {source} say that they are raw")
    leave_out("images that are broken or cut short", source, reader.broken)
    leave_out("bytes that belong to no packet or image", source, reader.skipped_bytes)
    told = [state for state in states if state is not None]
    if any(state.received_us < 0 for state in told):  # it came before the clock wrapped
        times = [None if time is None else time + WRAP_US for time in times]
        told = [replace(state, received_us=state.received_us + WRAP_US) for state in told]
    time_ns = _to_times_ns(times, source, options)
    pictures = _iter_image_samples(source, time_ns, options)
    return Content(merge_by_time([pictures, *_build_state_streams(told, options, source)]))


def _iter_images(source: Path, reader: ImageReader) -> Iterator[Image]:
    with source.open("rb") as stream:
        while data := stream.read(READ_BYTES):
            yield from reader.feed(data)
    reader.finish()


def _to_times_ns(
    times_us: Sequence[int | None], source: Path, options: Options
) -> list[int | None]:
    """Return the camera's times, or nominal ones unless every image has one.

    None stands for an image whose time is wrong, which is left out.
    """
    if any(time is None for time in times_us):
        return [round(k * 1e9 / options.rate_hz) for k in range(len(times_us))]
    options.refuse("rate_hz", f"has no effect: {source} has the times of its camera")
    told_ns = [1000 * (time or 0) for time in times_us]
    found = settle_times(told_ns, lambda row: f"{source}: image {row + 1}")
    settled = dict(zip(found.rows.tolist(), found.time_ns.tolist(), strict=True))
    latest = accumulate((settled.get(row, 0) for row in range(len(told_ns))), max)
    return [moment if row in settled else None for row, moment in enumerate(latest)]


def _iter_image_samples(
    source: Path, time_ns: Sequence[int | None], options: Options
) -> Iterator[Sample]:
    converter = PictureConverter(options, source)
    images = _iter_images(source, ImageReader())
    for k, (moment, found) in enumerate(zip(time_ns, images, strict=True)):
        where = f"{source}: picture {k}"
        if moment is None:
            continue
        if found.encoding == "jpeg":
            converted = converter.convert(moment, found.data, where)
        else:
            raw = np.frombuffer(found.data, np.uint8).reshape(found.height_px, found.width_px)
            converted = converter.convert_pixels(moment, demosaic(raw), None, where)
        yield from converted[1] if converted else ()
    converter.report()


def _build_state_streams(
    states: Sequence[RobotState], options: Options, source: Path
) -> list[log_variables.SampleStream]:
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
    block = LogBlock("cpx_state", time_ns, columns)
    return log_variables.build_streams(options.robot, [block], options.names, source)


FORMAT = Format(
    "aideck-stream",
    "a recorded CPX stream",
    can_read,
    load_content,
    SOURCE_OPTIONS | {"rate_hz", "camera", "size_px", "raw"},
)
