"""Settings of rendered images: the ranges of all random draws."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from dmrl.errors import RecipeError

Range = tuple[float, float]

ANY = (-float("inf"), float("inf"))
# Minimum and maximum of every key that is a number or a range of numbers.
LIMITS: dict[str, Range] = {
    "images": (1, 9_999_999),
    "seed": (0, 2**31 - 1),
    "workers": (0, 256),
    "samples": (1, 4096),
    "scale": (1e-9, 1e9),
    "cutout_width_m": (0.01, 3.0),
    "rate_hz": (1e-3, 1e4),
    "test_share": (0, 1),
    "empty_share": (0, 1),
    "robots_max": (1, 20),
    "place_u": (0, 1),
    "place_v": (0, 1),
    "depth_m": (0.08, 50.0),
    "robot_tilt_max_deg": (0, 90),
    "camera_tilt_max_deg": (0, 60),
    "speed_max_mps": (0, 20),
    "shutter_s": (0, 0.1),
    "shake_max_dps": (0, 500),
    "rotor_speed_rps": (0, 1000),
    "rotors_stopped_share": (0, 1),
    "wear": (0, 1),
    "colour_spread": (0, 1),
    "painted_share": (0, 1),
    "light_strength": (0, 20),
    "sun_strength": (0, 50),
    "robot_gain": (0.05, 20),
    "robot_blur_px": (0, 5),
    "background_zoom": (1, 8),
    "recoloured_share": (0, 1),
    "background_contrast": (0.2, 5),
    "background_blur_px": (0, 20),
    "brightness": (0.02, 0.98),
    "contrast_gamma": (0.5, 3),
    "warmth": (0.2, 5),
    "saturation": (0, 1),
    "vignetting": (0, 1),
    "defocus_px": (0, 10),
    "shot_noise": (0, 0.1),
    "read_noise": (0, 0.3),
    "jpeg_quality": (1, 100),
}


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


# Defaults by the recipe's key `preset`. The recipe's other keys override them.
PRESETS: dict[str, dict[str, Any]] = {
    # The HM01B0 of the AI-deck: raw response, no white balance, small lens.
    "himax": {
        "camera": "aideck",
        "distorted": True,
        "robots_max": 1,
        "speed_max_mps": 0.6,
        "shutter_s": [0.002, 0.012],
        "shake_max_dps": 40.0,
        "background_blur_px": [0.0, 1.0],
        "robot_gain": [0.25, 1.4],
        "brightness": [0.28, 0.58],
        "contrast_gamma": [1.2, 1.9],
        "warmth": [0.5, 4.0],
        "saturation": [0.2, 0.7],
        "vignetting": [0.55, 0.95],
        "defocus_px": [0.2, 1.2],
        "bayer": True,
        "shot_noise": [0.0001, 0.001],
        "read_noise": [0.001, 0.005],
        "jpeg_quality": [98, 100],  # below, JPEG makes noise coarser than that of real images
    },
    # The authors' renders: f = 120 px, centred, robots at twice life size, a clean camera.
    "published": {
        "camera": "published",
        "distorted": False,
        "robots_max": 1,
        "empty_share": 0.0,
        "scale": 2.0,
        "place_u": [0.0875, 0.9125],  # y/x to 1.1
        "place_v": [0.045, 0.955],  # z/x to 0.85
        "depth_m": [0.2, 2.0],
        "robot_turns": "xzy",
        "rotors_stopped_share": 1.0,
        "background_zoom": [1.0, 1.0],
        "background_blur_px": [0.0, 0.0],
        "wear": [0.0, 0.0],
        "pasted": True,
        "depth_spacing": "linear",
        "light_strength": [0.08, 0.16],
        "sun_strength": [1.5, 1.9],
        "robot_gain": [1.0, 1.0],
        "robot_blur_px": [0.35, 0.5],
        "jpeg_subsampled": True,
        "jpeg_quality": [90, 90],
    },
    # Cut-outs over frames of the camera itself, which keep their values.
    "cutouts": {
        "pasted": True,
        "background_blur_px": [0.0, 0.0],
        "background_zoom": [1.0, 1.2],
        "robot_gain": [0.3, 1.3],
        "depth_m": [0.15, 2.2],
    },
    "plain": {},
}


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
