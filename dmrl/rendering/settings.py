"""What a run of renders may look like: every range that poses and looks are drawn from."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from dmrl.errors import RecipeError

Range = tuple[float, float]

ANY = (-float("inf"), float("inf"))
# Least and greatest sensible value of every key that is a number or a range of numbers.
LIMITS: dict[str, Range] = {
    "images": (1, 9_999_999),
    "seed": (0, 2**31 - 1),
    "workers": (0, 256),
    "samples": (1, 4096),
    "scale": (1e-9, 1e9),
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
    """What is rendered. A range is drawn from anew for every image.

    Parameters
    ----------
    images
        Images to render.
    seed
        Another seed renders other images.
    workers
        Blender processes. 0: as many as there are cores. Changes no byte of the output.
    samples
        Light paths per pixel.
    camera
        aideck: the paper's calibration. published: that of the published renders. Else a TOML
        file as ``dmrl calibrate`` writes, of any size; its mount and delay are left out.
    distorted
        Whether images have the camera's lens distortion.
    design
        The robot that dmrl draws. crazyflie: with its decks. violet: a bare one in the colours of
        the published renders.
    model
        .blend, .glb, .obj or .stl of a robot, in place of the drawn one.
    model_up
        Axis of the model's file that points up. auto: as is usual for its kind, y of .obj and
        .glb, z of .stl and .blend.
    model_centre
        What of the model its labels are about: the middle of its box, or the file's origin.
    scale
        Metres per unit of the model; without a model, times life size.
    backgrounds
        Folder of photos, a dataset, or rooms, which are made by code. Without it, what the
        panoramas show.
    lights
        Folder of panoramas (.exr, .hdr). Without it, those that come with Blender.
    masks
        Whether to write a mask of every robot.
    depths
        Whether to write a depth image.
    rate_hz
        Images per second of the recording's time.
    test_share
        Share of images, the last ones, that form the test split, 0 to 1.
    empty_share
        Share of images without a robot, 0 to 1.
    robots_max
        Robots in an image, at most; every number is as likely.
    place_u, place_v
        Range of robots' centres across and down the image, shares of its width and height.
    depth_m
        Range of depths.
    depth_spacing
        log: every factor of depth is as likely; linear: every metre.
    robot_tilt_max_deg
        Roll and pitch of the robots, at most.
    robot_turns
        Axes of the robots' turns, from the horizontal frame on. zyx: yaw, pitch, roll, as
        aircraft count. xzy: roll, yaw, pitch, as the authors' script.
    camera_tilt_max_deg
        Roll and pitch of the camera, at most.
    speed_max_mps
        Speed of the robots seen from the camera, at most.
    shutter_s
        Range of exposure times, with which speed and shake smear.
    shake_max_dps
        Turning rate of the camera, at most, degrees per second.
    rotor_speed_rps
        Range of rotor speeds, turns per second.
    rotors_stopped_share
        Share of robots whose rotors stand still.
    wear
        Range of wear: worn robots are duller and greyer.
    colour_spread
        How far colours of parts vary, 0 to 1.
    painted_share
        Share of robots in two strong colours drawn at random, as of another make. They are called
        painted2 and so on in place of cf2.
    light_strength
        Range of the panorama's light on the robots.
    sun_strength
        Range of the sun's or lamp's light on the robots, watts per square metre.
    robot_gain
        Range of the light of robots over that of the background; every factor is as likely.
    robot_blur_px
        Range of the blur of the robots alone, a standard deviation, pixels: what a renderer's
        pixel filter does to what it lays over a photo.
    pasted
        Whether robots are laid over photos as the authors did: the photo keeps its values, and
        the robots are lit by a lamp at the camera that knows nothing of the photo. Without
        photos, no.
    background_zoom
        Range of how far photos are zoomed into.
    recoloured_share
        Share of photos whose colours are exchanged: leaves may be blue.
    background_contrast
        Range of the power that the background's light is raised to, about its mean; every factor
        is as likely. Over 1, its bright places stand out more.
    background_blur_px
        Range of the background's blur, a standard deviation, pixels.
    brightness
        Range of the mean of the image, 0 to 1.
    contrast_gamma
        Range of the response: 1 is proportional to light, 2.2 as screens expect.
    warmth
        Range of red over blue; every factor is as likely.
    saturation
        Range of how well the sensor tells colours apart, 0 to 1.
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
        Of the images in the recording.
    jpeg_quality
        Range of qualities, 1 to 100.
    jpeg_subsampled
        Whether four pixels share their colour (4:2:0).
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
        if faults := list(_faults(self)):
            raise ValueError("; ".join(faults))


def _faults(settings: Settings) -> list[str]:
    """Every value that is out of its limits, and every range that is upside down."""
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


# Defaults of a recipe that says `preset`; its own keys come before them.
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
        "jpeg_quality": [98, 100],  # below, JPEG makes the grain as coarse as it is not
    },
    # The authors' renders: f = 120 px about the middle, twice life size, a clean camera.
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
    "plain": {},
}


def filled(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of a recipe over those of its preset.

    Raises
    ------
    RecipeError
        If there is no such preset.
    """
    own = dict(keys)
    preset = own.pop("preset", "plain")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise RecipeError(f"no preset {preset!r}. There are: {', '.join(PRESETS)}")
    return PRESETS[preset] | own
