"""A folder of images, with labels in a CSV file if there is one.

Images: ``.png .jpg .jpeg .ppm .pgm .bmp``, in the order of their names. If every name is a
number of 12 digits or more, the numbers are times in nanoseconds; otherwise the images
get nominal times, evenly spaced from 0.

Labels: ``labels.csv`` in the folder, or another file. It has one row per peer and image; a row
with an empty peer means that no peer is in view. An image without a row is not labelled.

* ``file, peer, u_px, v_px, depth_m`` are required;
* ``left_px, top_px, right_px, bottom_px, visible_share, source, split, sigma_u_px,
  sigma_v_px, sigma_depth_m`` are optional. An empty ``source`` is "hand".

Or ``label.txt`` as the published firmware's tools write it, ``imgNNNNN.ppm roll pitch x y z d``
per line: see ``published_firmware``. Its labels need a camera. Maps of a chip: see
``chip_outputs``.

Pixels are those of the stored image, in pixel-edge coordinates. ``calibration.toml`` in the
folder is the camera of the images as they are stored (keys: see ``Camera``). Images of the
AI-deck's whole sensor, 324x244, with a camera of 320x224 are cropped to the area of that camera,
unless 324x244 is requested.
"""

from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from dmrl.errors import SettingError, SourceError
from dmrl.formats.aideck import published_firmware
from dmrl.formats.aideck.chip_outputs import load_chip_maps
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.files.crop import Crop
from dmrl.formats.files.label_csv import LabelRow, read_labels
from dmrl.geometry.camera_file import read_camera
from dmrl.geometry.frames import AIDECK, AIDECK_CORNER_PX, AIDECK_SENSOR_PX, Camera
from dmrl.guards import limits
from dmrl.guards.paths import refuse_pipes
from dmrl.images import codec
from dmrl.images.bayer import demosaic
from dmrl.samples.sample import Sample, build_calibration, build_image, build_labels, find_intervals
from dmrl.terminal.progress import say

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp")
LABELS_FILE = "labels.csv"
AIDECK_LABELS_FILE = "label.txt"
CALIBRATION_FILE = "calibration.toml"
MIN_TIME_DIGITS = 12  # fewer would be under 17 minutes after 1970: a counter, not a time
NS_PER_S = 1_000_000_000
MAX_TIME_NS = 2**63 - 1


def can_read(source: Path) -> bool:
    """Return whether a folder has an image."""
    return source.is_dir() and any(_is_image(path) for path in source.iterdir())


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a folder: images in time order, with their labels.

    Parameters
    ----------
    source
        The folder.
    options
        All but ``columns``; of ``names`` only "0", the peer of ``label.txt``.

    Raises
    ------
    SourceError
        If there is no image, one cannot be decoded, or the labels do not match them: names
        the file, and the line.
    SettingError
        If the camera does not have the images' size.
    """
    own = source / CALIBRATION_FILE
    if options.camera is None and own.is_file():
        options = replace(options, camera=read_camera(own))
    pictures = list_images(source, options.rate_hz)
    path = options.labels or source / LABELS_FILE
    known = {picture.name for _, picture in pictures}
    rows = read_labels(path, known) if options.labels or path.is_file() else {}
    splits = {name: found[0].split for name, found in rows.items()}
    states = _load_aideck_labels(source / AIDECK_LABELS_FILE, known)
    if states.keys() - rows.keys() and options.camera is None:
        say(
            f"{source / AIDECK_LABELS_FILE} gives no labels without a camera. Pass: --camera aideck"
        )
    return Content(
        samples=_iter_samples(pictures, rows, states, options),
        total=len(pictures) + len(rows) + (options.camera is not None),
        split=find_intervals((time_ns, splits.get(p.name)) for time_ns, p in pictures),
    )


def list_images(source: Path, rate_hz: float) -> list[tuple[int, Path]]:
    """List (time_ns, path) of every image in a folder, in time order.

    Raises
    ------
    SourceError
        If there is none, only some are named by times, or two have the same time.
    """
    if not source.is_dir():
        raise SourceError(f"no folder {source}. Pass a folder of images")
    refuse_pipes(source)
    paths = sorted(path for path in source.iterdir() if _is_image(path))
    if not paths:
        raise SourceError(
            f"no image ({', '.join(IMAGE_SUFFIXES)}) in {source}. Pass another folder"
        )
    timed = [path for path in paths if _parse_time_ns(path) is not None]
    if not timed:
        return [(round(k * NS_PER_S / rate_hz), path) for k, path in enumerate(paths)]
    if odd := sorted(set(paths) - set(timed)):
        raise SourceError(
            f"{odd[0]} is not named by its time in nanoseconds as {timed[0].name} is. "
            "Rename it, or move it out of the folder"
        )
    moments = sorted((_parse_time_ns(path) or 0, path) for path in paths)
    for (time_ns, path), (next_ns, following) in pairwise(moments):
        if time_ns == next_ns:
            raise SourceError(f"{path} and {following.name} have the same time. Remove one")
    return moments


def _parse_time_ns(path: Path) -> int | None:
    if not (path.stem.isdecimal() and len(path.stem) >= MIN_TIME_DIGITS):
        return None
    if int(path.stem) > MAX_TIME_NS:
        raise SourceError(f"{path}: time after the year 2262. Name it by nanoseconds since 1970")
    return int(path.stem)


def _load_aideck_labels(path: Path, files: Collection[str]) -> dict[str, list[float]]:
    """Load six numbers per image from ``label.txt``, if it exists."""
    found: dict[str, list[float]] = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    except (OSError, UnicodeDecodeError) as e:
        raise SourceError(f"{path} cannot be read as text: {e}. Restore the file") from None
    for number, line in enumerate(lines, 1):
        name, *words = line.replace(",", " ").split() or [""]
        if not name:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != len(published_firmware.VARIABLES):
            wanted = " ".join(published_firmware.VARIABLES)
            raise SourceError(f"{path}:{number}: not an image and {wanted}. Fix the line")
        if (name := name.rsplit("/", 1)[-1]) not in files:
            raise SourceError(f"{path}:{number}: no image {name}. Add it, or delete the line")
        found[name] = values
    return found


def _iter_samples(
    pictures: list[tuple[int, Path]],
    rows: dict[str, list[LabelRow]],
    states: dict[str, list[float]],
    options: Options,
) -> Iterator[Sample]:
    """Yield the calibration, then each image, its labels, and the firmware's numbers."""
    for k, (time_ns, path) in enumerate(pictures):
        crop, data, kind = _load_image(path, options)
        if options.camera is not None and k == 0:
            yield build_calibration(time_ns, options.robot, _crop_camera(crop, options.camera))
        yield build_image(time_ns, options.robot, data, kind)
        if (maps := load_chip_maps(path, time_ns, options.robot)) is not None and not crop.changes:
            yield maps
        if path.name in rows:
            peers = [crop.crop_label(row) for row in rows[path.name] if row.peer]
            sources = {row.source for row in rows[path.name]}
            yield build_labels(time_ns, options.robot, [row.to_fields() for row in peers], sources)
        if path.name in states:
            known = options.camera if path.name not in rows else None
            camera = _crop_camera(crop, known) if known else None
            peer = options.names.get("0", "cf2")
            yield from published_firmware.iter_samples(
                time_ns, options.robot, peer, states[path.name], camera
            )


def _load_image(path: Path, options: Options) -> tuple[Crop, bytes, str]:
    """Return the crop, bytes and format of an image; the bytes are unchanged if possible."""
    data = path.read_bytes()
    rgb = _decode_raw(data, path) if options.raw else codec.decode(data, path, limits.PIXELS)
    crop = _build_crop(rgb.shape[1], rgb.shape[0], path, options)
    if crop.changes:
        return crop, codec.encode_png(crop.crop_image(rgb)), "png"
    kind = "raw" if options.raw else codec.read_size(data)[2]
    if kind in ("png", "jpeg"):
        return crop, data, kind
    return crop, codec.encode_png(rgb), "png"


def _decode_raw(data: bytes, path: Path) -> codec.Rgb:
    rgb = codec.decode(data, path, limits.PIXELS)
    if (rgb != rgb[..., :1]).any() or min(rgb.shape[:2]) < 4:
        raise SourceError(f"{path} has colours already, so it is not raw. Remove --raw")
    return demosaic(rgb[..., 0].copy())


def _build_crop(width_px: int, height_px: int, path: Path, options: Options) -> Crop:
    camera, size = options.camera, (width_px, height_px)
    if camera is None or size == _camera_size(camera):
        return Crop(*size, *(options.size_px or size))
    if size == AIDECK_SENSOR_PX and _camera_size(camera) == _camera_size(AIDECK):
        wanted = options.size_px or _camera_size(AIDECK)
        return Crop(*size, *wanted, (0, 0) if wanted == size else AIDECK_CORNER_PX)
    raise SettingError(
        f"{path} is {width_px}x{height_px} px, its camera {camera.width_px}x"
        f"{camera.height_px}. Pass the calibration of the images as they are stored"
    )


def _camera_size(camera: Camera) -> tuple[int, int]:
    return camera.width_px, camera.height_px


def _crop_camera(crop: Crop, camera: Camera) -> Camera:
    """Return the camera of the cropped images, from that of the stored ones.

    A camera smaller than the stored images is centred in them.
    """
    left = (crop.from_width_px - camera.width_px) / 2
    top = (crop.from_height_px - camera.height_px) / 2
    stored = replace(camera, cx_px=camera.cx_px + left, cy_px=camera.cy_px + top)
    return crop.crop_camera(stored)


IMAGE_OPTIONS = SOURCE_OPTIONS | {"rate_hz", "labels", "camera", "size_px", "raw"}
FORMAT = Format("images", "a folder of pictures", can_read, load_content, IMAGE_OPTIONS)
