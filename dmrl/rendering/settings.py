"""Settings of rendered images: the ranges of all random draws."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from dmrl.errors import RecipeError

Range = tuple[float, float]

ANY = (-float("inf"), float("inf"))
TABLE = tomllib.loads(files(__package__).joinpath("settings.toml").read_text("utf-8"))
LIMITS: dict[str, list[float]] = TABLE["limits"]
"""Minimum and maximum of every key that is a number or a range of numbers."""
PRESETS: dict[str, dict[str, Any]] = TABLE["presets"]
"""Defaults by the recipe's key `preset`. The recipe's other keys override them."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of rendered images. A range is sampled anew for every image.

    Parameters
    ----------
    images
        Number of images.
    seed
        Seed of all random draws.
    workers
        Blender processes. 0: one per core. Does not change the output.
    samples
        Light paths per pixel.
    camera
        aideck: the paper's calibration. published: that of the published renders. Otherwise a TOML
        file as written by ``dmrl calibrate``, of any image size; its mount and delay are ignored.
    distorted
        Whether images have the camera's lens distortion.
    design
        Built-in robot. crazyflie: with its decks. violet: a bare one in the colours of the
        published renders.
    model
        .blend, .glb, .obj or .stl file of a robot, instead of the built-in one.
    model_up
        Axis of the model's file that points up. auto: y of .obj and .glb, z of .stl and .blend.
    model_centre
        Reference point of the labels: the middle of the model's box, or the file's origin.
    scale
        Metres per unit of the model. Without a model, times life size.
    cutouts
        Folder of photographs of the robot, PNG with alpha, in place of a model. Wants backgrounds.
    cutout_width_m
        True width of the robot in them.
    backgrounds
        Folder of photos, a dataset, or rooms for generated rooms. Default: the panoramas.
    lights
        Folder of panoramas (.exr, .hdr). Default: those that ship with Blender.
    masks
        Whether to write a mask of every robot.
    depths
        Whether to write a depth image.
    rate_hz
        Images per second of the recording's time.
    test_share
        Share of images in the test split, taken from the end, 0 to 1.
    empty_share
        Share of images without a robot, 0 to 1.
    robots_max
        Robots per image, at most. Every number is equally likely.
    place_u, place_v
        Ranges of the robots' centres across and down the image, shares of its width and height.
    depth_m
        Range of depths.
    depth_spacing
        log: log-uniform depths. linear: uniform depths.
    robot_tilt_max_deg
        Roll and pitch of the robots, at most.
    robot_turns
        Order of the robots' rotations, starting from the horizontal frame. zyx: yaw, pitch, roll
        (aerospace convention). xzy: roll, yaw, pitch, as in the authors' script.
    camera_tilt_max_deg
        Roll and pitch of the camera, at most.
    speed_max_mps
        Speed of the robots relative to the camera, at most.
    shutter_s
        Range of exposure times, which determine motion blur.
    shake_max_dps
        Turning rate of the camera, at most, degrees per second.
    rotor_speed_rps
        Range of rotor speeds, turns per second.
    rotors_stopped_share
        Share of robots with stopped rotors.
    wear
        Range of wear: worn robots are duller and greyer.
    colour_spread
        Variation of the colours of parts, 0 to 1.
    painted_share
        Share of robots in two strong random colours, as of another make. They are named painted2
        and so on instead of cf2.
    light_strength
        Range of the panorama's light on the robots.
    sun_strength
        Range of the sun's or lamp's light on the robots, watts per square metre.
    robot_gain
        Range of the robots' light relative to the background, log-uniform.
    robot_blur_px
        Range of the blur of the robots alone, a standard deviation, pixels. Models the pixel filter
        of a renderer that composites over a photo.
    pasted
        Whether robots are composited over photos as the authors did: the photo keeps its values,
        and a lamp at the camera lights the robots independently of it. Cut-outs take its light.
        Ignored without photos.
    background_zoom
        Range of zoom factors of the photos.
    recoloured_share
        Share of photos whose colour channels are permuted: leaves may be blue.
    background_contrast
        Range of the exponent applied to the background's light, relative to its mean, log-uniform.
        Above 1, bright areas become brighter.
    background_blur_px
        Range of the background's blur, a standard deviation, pixels.
    brightness
        Range of the mean image brightness, 0 to 1.
    contrast_gamma
        Range of the response exponent: 1 is linear, 2.2 matches screens.
    warmth
        Range of the ratio of red to blue, log-uniform.
    saturation
        Range of the sensor's colour separation, 0 to 1.
    vignetting
        Range of light lost in the corners, 0 to 1.
    defocus_px
        Range of the lens' blur, a standard deviation, pixels.
    bayer
        Whether the sensor measures one colour per pixel.
    shot_noise
        Range of the noise's variance per unit of light.
    read_noise
        Range of the noise's standard deviation in the dark, full scale 1.
    image_format
        Encoding of the images in the recording.
    jpeg_quality
        Range of qualities, 1 to 100.
    jpeg_subsampled
        Whether four pixels share their chroma (4:2:0).
    """

    images: int = 1000
    seed: int = 0
    workers: int = 0
    samples: int = 8
    camera: Path = Path("aideck")
    distorted: bool = True
    design: Literal["crazyflie", "violet"] = "crazyflie"
    model: Path | None = None
    model_up: Literal["auto", "y", "z"] = "auto"
    model_centre: Literal["box", "origin"] = "box"
    scale: float = 1.0
    cutouts: Path | None = None
    cutout_width_m: float = 0.13
    backgrounds: Path | None = None
    lights: Path | None = None
    masks: bool = False
    depths: bool = False
    rate_hz: float = 10.0
    test_share: float = 0.2
    empty_share: float = 0.1
    robots_max: int = 1
    place_u: Range = (0.0, 1.0)
    place_v: Range = (0.0, 1.0)
    depth_m: Range = (0.2, 2.0)
    depth_spacing: Literal["log", "linear"] = "log"
    robot_tilt_max_deg: float = 20.0
    robot_turns: Literal["zyx", "xzy"] = "zyx"
    camera_tilt_max_deg: float = 20.0
    speed_max_mps: float = 0.0
    shutter_s: Range = (0.0, 0.0)
    shake_max_dps: float = 0.0
    rotor_speed_rps: Range = (200.0, 350.0)
    rotors_stopped_share: float = 0.1
    wear: Range = (0.0, 0.6)
    colour_spread: float = 0.3
    painted_share: float = 0.0
    light_strength: Range = (0.5, 1.5)
    sun_strength: Range = (0.0, 3.0)
    robot_gain: Range = (0.5, 1.5)
    robot_blur_px: Range = (0.0, 0.0)
    pasted: bool = False
    background_zoom: Range = (1.0, 2.0)
    recoloured_share: float = 0.0
    background_contrast: Range = (1.0, 1.0)
    background_blur_px: Range = (0.0, 1.0)
    brightness: Range = (0.3, 0.6)
    contrast_gamma: Range = (2.2, 2.2)
    warmth: Range = (0.9, 1.1)
    saturation: Range = (1.0, 1.0)
    vignetting: Range = (0.0, 0.0)
    defocus_px: Range = (0.0, 0.0)
    bayer: bool = False
    shot_noise: Range = (0.0, 0.0)
    read_noise: Range = (0.0, 0.0)
    image_format: Literal["jpeg", "png"] = "jpeg"
    jpeg_quality: tuple[int, int] = (95, 95)
    jpeg_subsampled: bool = False

    def __post_init__(self) -> None:
        faults = list(_find_faults(self))
        if self.cutouts is not None and self.backgrounds is None:
            faults.append("cutouts: they want backgrounds, a folder of photos, a dataset or rooms")
        if faults:
            raise ValueError("; ".join(faults))


def _find_faults(settings: Settings) -> list[str]:
    """List all values outside their limits and all reversed ranges."""
    faults = []
    for key in fields(settings):
        low, high = LIMITS.get(key.name, ANY)
        value: Any = getattr(settings, key.name)
        numbers = value if isinstance(value, tuple) else (value,)
        if key.name not in LIMITS:
            continue
        if not all(low <= number <= high for number in numbers):
            faults.append(f"{key.name}: {value} is not within {low:g} to {high:g}")
        elif list(numbers) != sorted(numbers):
            faults.append(f"{key.name}: {value} ends before it begins")
    return faults


def filled(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Merge a recipe's keys over those of its preset.

    Raises
    ------
    RecipeError
        If the preset does not exist.
    """
    own = dict(keys)
    preset = own.pop("preset", "plain")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise RecipeError(f"no preset {preset!r}. There are: {', '.join(PRESETS)}")
    return PRESETS[preset] | own
