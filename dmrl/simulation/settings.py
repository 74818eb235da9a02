"""Settings of commands of this room. Imports nothing heavy: they are flags."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

from dmrl.deploy.backend_names import BackendName
from dmrl.terminal.arguments import Seed, Share

CameraRenderer = Literal["sketch", "blender"]
Preset = Literal["ideal", "calibrated", "realistic", "harsh", "published"]
Trajectory = Literal[
    "in_view",
    "random",
    "room",
    "lawn_mower",
    "hover",
    "parallel",
    "observer_static",
    "peer_static",
    "no_yaw",
    "both_static",
    "figure_of_eight",
]
NAMED_EYES = ("truth", "ideal")
Eye = Literal["truth", "ideal"] | Path
"""One of `NAMED_EYES`, or a model."""
Count = Annotated[int, Parameter(validator=validators.Number(gte=2))]


@dataclass(frozen=True, slots=True)
class SketchSettings:
    """Number and content of the pictures.

    Parameters
    ----------
    images
        Pictures to draw.
    seed
        Another seed draws other pictures.
    robots_max
        Robots in a picture, at most.
    empty_share
        Share of pictures without a robot, 0 to 1.
    test_share
        Share of pictures, the last ones, that form the test split, 0 to 1.
    """

    images: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=999_999))] = 600
    seed: Seed = 0
    robots_max: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=20))] = 3
    empty_share: Share = 0.1
    test_share: Share = 0.2


@dataclass(frozen=True, slots=True)
class DroneSettings:
    """Form of the images that drones send, and the faults of drones and links.

    Parameters
    ----------
    sends
        Form of the images: raw ones in Bitcraze's layout (plain), with its time stamp
        (stamped) or in nanocockpit's (streamer); or jpeg.
    drop
        Share of log packets and images that are not sent, 0 to 1.
    dies
        ROBOT=S: that robot is silent from second S of the flight; ROBOT=S:T: until T, when
        it starts anew. Repeat for more.
    speed
        Seconds of the flight per second.
    boot_ms
        Time of the drones' clocks at take-off; they wrap after 16777216 ms.
    drift_ppm
        How much faster each drone's clock runs than the one before.
    seed
        Another seed drops others.
    """

    sends: Literal["plain", "stamped", "streamer", "jpeg"] = "plain"
    drop: Annotated[float, Parameter(validator=validators.Number(gte=0, lt=1))] = 0.0
    dies: Annotated[tuple[str, ...], Parameter(negative=())] = ()
    speed: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=100))] = 1.0
    boot_ms: Annotated[float, Parameter(validator=validators.Number(gte=0))] = 12_340.0
    drift_ppm: float = 0.0
    seed: Annotated[int, Parameter(validator=validators.Number(gte=0))] = 0


@dataclass(frozen=True, slots=True)
class LikenessSettings:
    """Preset and backgrounds of a fit, and the number of frames.

    Parameters
    ----------
    preset
        Of dmrl render, to start from: plain, himax or published.
    backgrounds
        Scenes behind the robots: rooms, which are made by code, a folder of photos, or a dataset.
    frames
        Frames that are looked at, at most, evenly over all.
    seed
        Of the pictures that are made for comparison.
    """

    preset: str = "himax"
    backgrounds: Path = Path("rooms")
    frames: Count = 200
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Vision:
    """Delay and losses between a camera and its pilot, and the errors of an ideal eye.

    Parameters
    ----------
    delay_images
        Detections reach the pilot so many images late.
    lost_share
        Share of the images that are lost, at random, 0 to 1.
    lost_images
        Numbers of images that are lost, from 0.
    pixel_std_px, depth_std_ratio
        Errors of an ideal eye: of u and v, and of the depth over the depth.
    miss_share
        Share of the images in which an ideal eye misses a peer, 0 to 1.
    miss_burst_s
        Mean duration of the misses. 0: each image for itself.
    magnify
        A network sees the middle of every second image, 3/2 times as large.
    """

    delay_images: Annotated[int, Parameter(validator=validators.Number(gte=0, lte=10))] = 1
    lost_share: Share = 0.0
    lost_images: tuple[Annotated[int, Parameter(validator=validators.Number(gte=0))], ...] = ()
    pixel_std_px: Annotated[float, Parameter(validator=validators.Number(gte=0))] = 1.0
    depth_std_ratio: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1))] = 0.1
    miss_share: Annotated[float, Parameter(validator=validators.Number(gte=0, lt=1))] = 0.0
    miss_burst_s: Annotated[float, Parameter(validator=validators.Number(gte=0))] = 0.0
    magnify: bool = True


@dataclass(frozen=True, slots=True)
class FlyFlags:
    """Settings of a flight's recipe that a flag overrules.

    Parameters
    ----------
    robots
        2 to 20. Without it, the recipe's.
    duration_s
        Length of the flight. Without it, the recipe's.
    trajectory
        How they move. Without it, the recipe's.
    noise
        How wrong the sensors are. Without it, the recipe's.
    seed
        Another seed gives another flight. Without it, the recipe's.
    place
        Number of the room, for images by one camera in it. Without it, the recipe's.
    camera
        Render the images of every camera. Without it, as the recipe says.
    camera_renderer
        sketch: quick drawings. blender: rendered as by dmrl render; sets Blender up, once, if
        it is not. Without it, the recipe's.
    camera_rate_hz
        Pictures per second and robot. Without it, the recipe's.
    pilot
        Who flies the first robots: follow, keep_apart, formation or a plug-in's. Without it, the
        recipe's.
    eye
        What the pilot sees: truth; ideal; or a model, by its path or name. Without it, the
        recipe's.
    backend
        What computes the model, as in dmrl predict.
    distance_m
        Distance that the pilot keeps. Without it, the recipe's.
    """

    robots: int | None = None
    duration_s: float | None = None
    trajectory: Trajectory | None = None
    noise: Preset | None = None
    seed: int | None = None
    place: int | None = None
    camera: bool | None = None
    camera_renderer: CameraRenderer | None = None
    camera_rate_hz: float | None = None
    pilot: str | None = None
    eye: Eye | None = None
    backend: BackendName | None = None
    distance_m: float | None = None
