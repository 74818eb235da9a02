"""Calibration files of ROS, Kalibr and OpenCV: YAML, JSON or XML.

All of them count pixels from the centre of the first one, so half a pixel is added to the principal
point. Their plumb-bob model has the order of `Camera.distortion`.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from dmrl.errors import MissingExtra, SourceError
from dmrl.geometry.calibration import BINNING_KEYS, ROI_KEYS, crop_and_bin
from dmrl.geometry.frames import Camera
from dmrl.guards.bounded_parsing import parse_json, parse_number, parse_xml, parse_yaml
from dmrl.terminal.progress import say

SUFFIXES = (".yaml", ".yml", ".json", ".xml")
OPENCV_ONLY = re.compile(r"^%YAML.*$|!!opencv-(nd-)?matrix", re.MULTILINE)
"""A first line and tags of OpenCV that YAML does not allow."""
HALF_PX = 0.5
MAX_COEFFICIENTS = 5
"""Coefficients of the plumb-bob model; later ones of OpenCV's models must be 0."""
PLUMB_BOB = ("", "plumb_bob", "radtan", "radial-tangential", "rational_polynomial", "none")
"""Names of the model, and of OpenCV's with more coefficients."""
KEYS = {
    "matrix": ("cameramatrix", "intrinsicmatrix", "mtx", "k", "m1"),
    "distortion": (
        "distortioncoefficients",
        "distcoeffs",
        "distortioncoeffs",
        "distcoeff",
        "dist",
        "d",
        "d1",
    ),
    "size": ("resolution", "imagesize", "imgsize"),
    "width": ("imagewidth", "width"),
    "height": ("imageheight", "height"),
}
"""Keys in lower case without underscores: of ROS, of Kalibr, and of OpenCV's samples."""
FISHEYE, FISHEYE_COEFFICIENTS = "fisheyemodel", 4
"""OpenCV's key of the model, and the number of its coefficients."""
NAMES = {"matrix": "camera_matrix", "width": "image_width", "height": "image_height"}
"""Keys in errors."""


def parse_foreign_camera(text: str, path: Path) -> Camera:
    """Parse a calibration file of ROS, Kalibr or OpenCV. ``path`` is its name in errors.

    Raises
    ------
    SourceError
        If it is none, lacks a value, or has a lens model other than plumb bob.
    MissingExtra
        If it is YAML and PyYAML is not installed.
    """
    try:
        if path.suffix.lower() == ".json":
            document = parse_json(text)
        elif path.suffix.lower() == ".xml":
            document = {one.tag: _parse_element(one) for one in parse_xml(text.encode())}
        else:
            # `ros2 topic echo` ends each message with a line of three dashes.
            first = OPENCV_ONLY.sub("", text).lstrip().removeprefix("---")
            document = parse_yaml(re.split(r"^---\s*$", first, maxsplit=1, flags=re.MULTILINE)[0])
        if not isinstance(document, dict):
            raise ValueError("it is not a table of keys")
        camera = _build_camera(document, path)
    except ModuleNotFoundError as e:
        raise MissingExtra("pyyaml", "yolo", str(path)) from e
    except (ValueError, TypeError, OverflowError) as e:
        why = " ".join(str(e).split())[:200]
        raise SourceError(
            f"{path} is no calibration of ROS, Kalibr or OpenCV: {why}. Calibrate with dmrl "
            "calibrate, or write the camera as TOML: see docs/sources.md"
        ) from None
    if not camera.distortion and not re.search(r"model\W+none\b", text):
        say(f"{path}: no distortion coefficients found in it, so the lens is taken to have none")
    return camera


def _build_camera(document: Mapping[str, Any], path: Path) -> Camera:
    cameras = [key for key, value in document.items() if _is_kalibr(value)]
    if len(cameras) > 1:
        raise ValueError(f"it has {', '.join(cameras)}; keep one")
    table = document[cameras[0]] if cameras else document
    has_four = bool(cameras) or _is_kalibr(document)  # EuRoC's file of one camera has Kalibr's keys
    held = {str(key).lower().replace("_", ""): value for key, value in table.items()}
    if held.get("cameramodel", "pinhole") != "pinhole":
        raise ValueError(f"its camera_model is {held['cameramodel']}, not pinhole")
    if has_four:
        fx, fy, cx, cy = _to_numbers("intrinsics", held.get("intrinsics"), 4)
    else:
        fx, skew, cx, other, fy, cy, *below = _to_numbers("matrix", _find(held, "matrix"), 9)
        if abs(skew) > 1e-6 * abs(fx) or any((other, *below[:2])):
            raise ValueError("its camera matrix has a skew, or is transposed")
    size = _find(held, "size", None)
    if size is None:
        size = [_find(held, "width"), _find(held, "height")]
    width, height = _to_numbers("size", size, 2)
    matrix = np.array([[fx, 0.0, cx + HALF_PX], [0.0, fy, cy + HALF_PX]])
    roi = table.get("roi") or {}  # of the camera_info of ROS, as is the binning
    if not isinstance(roi, dict):
        raise ValueError("its roi is no table of keys")
    part = _to_numbers("roi", [roi.get(key, 0) for key in ROI_KEYS], 4)
    binning = _to_numbers("binning", [table.get(key, 0) for key in BINNING_KEYS], 2)
    width_px, height_px = crop_and_bin((width, height), part, binning, matrix)
    (fx, _, cx), (_, fy, cy) = matrix.tolist()
    if not (0 < fx < float("inf") and 0 < fy < float("inf") and width_px >= 1 and height_px >= 1):
        raise ValueError("its focal lengths and its size must be over 0")
    return Camera(width_px, height_px, fx, fy, cx, cy, _to_distortion(held, path))


def _parse_element(element: ElementTree.Element) -> Any:
    """Return a number, a matrix with its numbers as ``data``, or the text."""
    words = (element.findtext("data") or element.text or "").split()
    try:
        numbers = [parse_number(word) for word in words]
    except ValueError:
        return element.text
    return {"data": numbers} if len(element) or len(numbers) != 1 else numbers[0]


def _is_kalibr(value: object) -> bool:
    return isinstance(value, dict) and "intrinsics" in value


def _find(held: Mapping[str, Any], what: str, *default: Any) -> Any:
    """Return the value of the first key of ``what`` that there is, else the default."""
    for key in KEYS[what]:
        if key in held:
            return held[key]
    if default:
        return default[0]
    raise ValueError(f"it has no {NAMES.get(what, what)}")


def _to_numbers(what: str, value: Any, count: int | None) -> list[float]:
    """Return the finite numbers of a list, of a list of lists, or of a matrix with ``data``."""
    held = value["data"] if isinstance(value, dict) and "data" in value else value
    numbers = list(_flatten(held))
    if (count is not None and len(numbers) != count) or not np.isfinite(numbers).all():
        raise ValueError(f"its {what} has no {count or 'finite'} numbers")
    return numbers


def _flatten(value: Any) -> Iterator[float]:
    if isinstance(value, list):
        for one in value:
            yield from _flatten(one)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)
    else:
        raise ValueError(f"{str(value)[:40]!r} is no number")


def _to_distortion(held: Mapping[str, Any], path: Path) -> tuple[float, ...]:
    model = str(held.get("distortionmodel") or "")
    numbers = _to_numbers("distortion", _find(held, "distortion", []), None)
    if any(numbers) and (model not in PLUMB_BOB or held.get(FISHEYE)):
        raise ValueError(f"its lens model is {model or 'fisheye'}, not plumb_bob")
    if any(numbers) and len(numbers) == FISHEYE_COEFFICIENTS and not (model or FISHEYE in held):
        say(
            f"{path}: 4 coefficients without a model are read as k1, k2, p1, p2 of plumb bob. If "
            "they are a fisheye's, write distortion_model: fisheye into it"
        )
    if any(numbers[MAX_COEFFICIENTS:]):
        raise ValueError(f"its lens model has {len(numbers)} coefficients, not 5")
    return tuple(numbers[:MAX_COEFFICIENTS])
