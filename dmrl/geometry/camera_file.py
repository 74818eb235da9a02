"""File of a camera's calibration: TOML, or that of another tool."""

from dataclasses import MISSING, asdict, fields
from pathlib import Path

from dmrl.errors import SourceError
from dmrl.geometry import foreign_calibration
from dmrl.geometry.frames import AIDECK, PUBLISHED_RENDER, Camera
from dmrl.guards.bounded_parsing import parse_toml
from dmrl.guards.paths import refuse_pipe
from dmrl.terminal.progress import say

NAMED_CAMERAS = {"aideck": AIDECK, "published": PUBLISHED_RENDER}
"""Built-in cameras by name."""

INTEGER_KEYS = ("width_px", "height_px")
POSITIVE_KEYS = (*INTEGER_KEYS, "fx_px", "fy_px")
REQUIRED_KEYS = tuple(field.name for field in fields(Camera) if field.default is MISSING)
LIST_KEYS = ("distortion", "mount_rad")
MAX_COEFFICIENTS = 5
"""Maximum number of distortion coefficients: k1, k2, p1, p2, k3."""

KEYS = (*REQUIRED_KEYS, *LIST_KEYS, "delay_s")


def format_camera(camera: Camera) -> str:
    """Format a camera as a TOML document that ``read_camera`` can read."""
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(camera).items()}
    lines = [f"{key} = {value}" for key, value in values.items()]
    return "\n".join(
        ["# Pixel-edge coordinates: the image covers [0, width] x [0, height].", *lines, ""]
    )


def warn_of_mount(robot: str, camera: Camera) -> None:
    """Print a line if a robot's camera has a mount or delay, which a recording does not hold."""
    if any(camera.mount_rad) or camera.delay_s:
        say(
            f"{robot}: a recording does not hold the mount and delay of its camera. Pass the file "
            f"to dmrl label, too: --camera.{robot} FILE"
        )


def find_camera(name: Path) -> Camera:
    """Return the built-in camera with this name, or read a file.

    Parameters
    ----------
    name
        One of `NAMED_CAMERAS`, or a file.

    Raises
    ------
    SourceError
        As `read_camera`.
    """
    return NAMED_CAMERAS.get(str(name)) or read_camera(name)


def read_camera(path: Path) -> Camera:
    """Read a camera from a TOML file, or a YAML, JSON or XML file of ROS, Kalibr or OpenCV.

    Raises
    ------
    SourceError
        If the file is neither, or a key is unknown, missing or of the wrong type.
    """
    refuse_pipe(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SourceError(f"no calibration {path}. Use a TOML file, aideck or published") from None
    except (OSError, UnicodeDecodeError) as e:
        raise SourceError(f"{path} is not a TOML file: {e}. Keys: {', '.join(KEYS)}") from None
    if path.suffix.lower() in foreign_calibration.SUFFIXES:
        return foreign_calibration.parse_foreign_camera(text, path)
    return parse_camera(text, path)


def parse_camera(text: str, path: Path) -> Camera:
    """Parse a camera from a TOML document. ``path`` is its name in errors.

    Raises
    ------
    SourceError
        As `read_camera`.
    """
    try:
        values = parse_toml(text)
    except ValueError as e:
        raise SourceError(f"{path} is not a TOML file: {e}. Keys: {', '.join(KEYS)}") from None
    wrong = [key for key in values if key not in KEYS]
    wrong += [f"{key} (missing)" for key in REQUIRED_KEYS if key not in values]
    wrong += [key for key in REQUIRED_KEYS if key in values and not _is_number(key, values[key])]
    given = {key: values[key] for key in LIST_KEYS if key in values}
    wrong += [key for key, value in given.items() if not _is_list(key, value)]
    wrong += ["delay_s"] * (not _is_number("", values.get("delay_s", 0.0)))
    if wrong:
        raise SourceError(f"{path}: wrong keys {', '.join(wrong)}. Keys: {', '.join(KEYS)}")
    return Camera(**(values | {key: tuple(map(float, value)) for key, value in given.items()}))


def _is_list(key: str, value: object) -> bool:
    if not isinstance(value, list) or not all(_is_number("", one) for one in value):
        return False
    return len(value) == 3 if key == "mount_rad" else len(value) <= MAX_COEFFICIENTS


def _is_number(key: str, value: object) -> bool:
    kinds = (int,) if key in INTEGER_KEYS else (int, float)
    if not isinstance(value, kinds) or isinstance(value, bool):
        return False
    return abs(value) < float("inf") and (key not in POSITIVE_KEYS or value > 0)
