"""Dumps of the HyperFlash that the published firmware fills.

A record has 71,704 bytes: 224 x 320 raw pixels of the sensor (rows 10 to 233 and columns 2 to
321 of 244 x 324), then six little-endian float32, see ``published_firmware``. Erased flash is
0xFF, so an all-0xFF record ends the dump. The dump has no times: nominal ones are assigned.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.aideck import published_firmware
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.files.pictures import PictureConverter, crop_camera
from dmrl.geometry.frames import AIDECK
from dmrl.images.bayer import demosaic
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out

HEIGHT_PX, WIDTH_PX = 224, 320
PIXEL_COUNT = HEIGHT_PX * WIDTH_PX
RECORD = np.dtype([("raw", "u1", (HEIGHT_PX, WIDTH_PX)), ("values", "<f4", (6,))])
ERASED = b"\xff" * RECORD.itemsize


def can_read(source: Path) -> bool:
    """Return whether a file consists of records, the first plausible, and erased flash.

    The first record must have non-zero values, since the six floats of any file may be plausible.
    """
    if not source.is_file() or source.stat().st_size < RECORD.itemsize:
        return False
    with source.open("rb") as stream:
        stream.seek(PIXEL_COUNT)
        values = np.frombuffer(stream.read(RECORD.itemsize - PIXEL_COUNT), "<f4").tolist()
        stream.seek(source.stat().st_size // RECORD.itemsize * RECORD.itemsize)
        rest = stream.read().strip(b"\xff")
    return published_firmware.is_plausible(values) and any(values) and not rest


def iter_records(stream: BinaryIO, what: object = None) -> Iterator[np.void]:
    """Yield whole records up to the end marker or the end; report the bytes left out.

    Parameters
    ----------
    stream
        The dump.
    what
        Its name, for the line on stderr; None: print no line.
    """
    while len(data := stream.read(RECORD.itemsize)) == RECORD.itemsize:
        if data == ERASED:
            return
        yield np.frombuffer(data, RECORD)[0]
    if what is not None and data.strip(b"\xff"):
        leave_out("records that are cut short", f"{what}: its last {len(data)} bytes")


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a dump: images in RGB, attitude, and the firmware's estimate of the peer.

    Parameters
    ----------
    source
        The file.
    options
        ``robot``, ``rate_hz``, ``camera`` (default: the AI-deck's) and ``names``, where "0" names
        the peer (default: cf2).

    Raises
    ------
    SourceError
        If no whole record precedes the end marker, or most records are implausible.
    MissingExtra
        If OpenCV is not installed.
    """
    if not source.is_file():
        raise SourceError(f"{source} is not a file. Pass the dump of a flash")
    with source.open("rb") as stream:
        plausible = [
            published_firmware.is_plausible(r["values"].tolist()) for r in iter_records(stream)
        ]
    if not plausible:
        raise SourceError(f"{source} has no record of {RECORD.itemsize} bytes. Pass another dump")
    if 2 * sum(plausible) <= len(plausible):
        raise SourceError(
            f"{source}: {len(plausible) - sum(plausible)} of {len(plausible)} records have "
            "impossible numbers: it is not a dump, or its bytes are shifted. Pass another"
        )
    demosaic(np.zeros((4, 4), np.uint8))  # raises MissingExtra before anything is written
    return Content(_iter_samples(source, options), source.stat().st_size // RECORD.itemsize)


def _iter_samples(source: Path, options: Options) -> Iterator[Sample]:
    stored, peer = options.camera or AIDECK, options.names.get("0", "cf2")
    converter = PictureConverter(replace(options, camera=stored), source)
    with source.open("rb") as stream:
        for k, record in enumerate(iter_records(stream, source)):
            time_ns = round(k * 1e9 / options.rate_hz)
            rgb = demosaic(record["raw"])
            crop, samples = converter.convert_pixels(time_ns, rgb, None, source)
            yield from samples
            camera = crop_camera(crop, stored)
            values = record["values"].tolist()
            if not published_firmware.is_plausible(values):
                leave_out("labels of records with impossible numbers", f"{source}: record {k}")
            yield from published_firmware.iter_samples(time_ns, options.robot, peer, values, camera)


FORMAT = Format(
    "hyperflash",
    "a dump of the AI-deck's flash",
    can_read,
    load_content,
    SOURCE_OPTIONS | {"rate_hz", "camera", "size_px"},
)
