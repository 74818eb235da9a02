"""Random scenes, drawn from the ranges of the settings."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dmrl.geometry.frames import Array, Camera, camera_from_horizontal
from dmrl.rendering.backgrounds.panorama import Panorama
from dmrl.rendering.backgrounds.photos import Photos, apply_motion_blur, stretch_contrast
from dmrl.rendering.camera.distortion import FloatImage, pinhole_from_image
from dmrl.rendering.camera.sensor import Sensor, gaussian_blur
from dmrl.rendering.robots.crazyflie import CRAZYFLIE
from dmrl.rendering.robots.primitives import RobotDesign
from dmrl.rendering.settings import Range, Settings
from dmrl.rendering.shot import Light, Look, Robot
from dmrl.rendering.sketch_renderer import Pose
from dmrl.rendering.sketch_scene import place_apart

"""Attempts per robot to find a free place."""
HIGHLIGHT_LIMIT = 3.0
"""Clip panoramas at this multiple of their mean: suns and lamps would hide everything else."""
BEHIND_CAMERA = np.array([-1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class SceneSource:
    """Sources of random scenes.

    Parameters
    ----------
    settings
        Ranges.
    camera
        Camera whose image is filled.
    radius_m
        Radius of a ball that contains a robot, metres.
    lights
        Names of the panoramas.
    panorama
        Returns a panorama by its name.
    photos
        Backgrounds, or None to show the panoramas.
    design
        Robot whose parts are painted.
    """

    settings: Settings
    camera: Camera
    radius_m: float
    lights: tuple[str, ...]
    panorama: Callable[[str], Panorama]
    photos: Photos | None
    design: RobotDesign = CRAZYFLIE


@dataclass(frozen=True, slots=True)
class RandomScene:
    """A scene: attitude of the camera, robots, look, and JPEG quality."""

    roll_rad: float
    pitch_rad: float
    robots: tuple[Robot, ...]
    look: Look
    jpeg_quality: int


def draw_scene(world: SceneSource, index: int) -> RandomScene:
    """Draw scene number ``index``, independently of all other scenes.

    Parameters
    ----------
    world
        Sources of the scene.
    index
        Number of the image, from 0.
    """
    settings = world.settings
    rng = np.random.default_rng((settings.seed, index))
    tilt_rad = np.radians(settings.camera_tilt_max_deg)
    roll, pitch = rng.uniform(-tilt_rad, tilt_rad, 2).tolist()
    shutter_s = _draw_uniform(rng, settings.shutter_s)
    poses = _draw_poses(world, rng, camera_from_horizontal(roll, pitch))
    robots = tuple(_draw_robot(world, rng, pose, shutter_s) for pose in poses)
    look = _draw_look(world, rng, (roll, pitch), shutter_s)
    low, high = settings.jpeg_quality
    return RandomScene(roll, pitch, robots, look, int(rng.integers(low, high + 1)))


def _draw_uniform(rng: Generator, limits: Range) -> float:
    return float(rng.uniform(*limits))


def _draw_log_uniform(rng: Generator, limits: Range) -> float:
    """Draw a log-uniform number between limits."""
    return float(np.exp(rng.uniform(*np.log(limits))))


def _draw_poses(world: SceneSource, rng: Generator, tilt: Array) -> list[Pose]:
    settings = world.settings
    empty = rng.random() < settings.empty_share
    count = 0 if empty else int(rng.integers(1, settings.robots_max + 1))
    return place_apart(
        count,
        lambda: Pose(_draw_position(world, rng), tilt @ _draw_attitude(settings, rng)),
        lambda one, other: bool(np.linalg.norm(one - other) > 2 * world.radius_m),
    )


def _draw_position(world: SceneSource, rng: Generator) -> Array:
    """Draw a position, uniform in a region of the distorted image."""
    camera, settings = world.camera, world.settings
    size = np.array([camera.width_px, camera.height_px])
    low, high = np.transpose([settings.place_u, settings.place_v]) * size
    uv = rng.uniform(low, high)
    u_px, v_px = pinhole_from_image(uv, camera)
    draw = _draw_uniform if settings.depth_spacing == "linear" else _draw_log_uniform
    depth_m = draw(rng, settings.depth_m)
    return camera.point_at(u_px, v_px, depth_m)


def _draw_attitude(settings: Settings, rng: Generator) -> Array:
    """Draw the rotation horizontal_from_body."""
    tilt_rad = np.radians(settings.robot_tilt_max_deg)
    roll, pitch = rng.uniform(-tilt_rad, tilt_rad, 2).tolist()
    yaw = rng.uniform(-np.pi, np.pi)
    about = {"x": roll, "y": pitch, "z": yaw}
    order = settings.robot_turns
    turns = Rotation.from_euler(order.upper(), [about[axis] for axis in order])
    return np.asarray(turns.as_matrix())


def _draw_robot(world: SceneSource, rng: Generator, pose: Pose, shutter_s: float) -> Robot:
    settings, design = world.settings, world.design
    velocity = rng.normal(size=3)
    velocity *= settings.speed_max_mps * rng.random() / np.linalg.norm(velocity)
    stopped = rng.random() < settings.rotors_stopped_share
    # Without a shutter time, rotors are rendered as at 10 ms: a disc.
    open_s = shutter_s or 0.01
    sweep = 0.0 if stopped else 2 * np.pi * _draw_uniform(rng, settings.rotor_speed_rps) * open_s
    paint = random_paint(rng, design, _draw_uniform(rng, settings.wear), settings.colour_spread)
    painted = bool(settings.painted_share) and rng.random() < settings.painted_share
    if painted:
        paint |= random_two_colours(rng, design)
    paint |= {"rotor_first_rad": float(rng.uniform(0, np.pi)), "rotor_sweep_rad": float(sweep)}
    return Robot(pose, paint, velocity * shutter_s, "painted" if painted else "cf")


def random_paint(rng: Generator, design: RobotDesign, wear: float, spread: float) -> dict[str, Any]:
    """Draw the colour and finish of every material, as properties of the worker's shaders.

    Parameters
    ----------
    rng
        Random generator.
    design
        Robot to paint.
    wear
        0 for new, 1 for grey and dull.
    spread
        Variation of the colours, 0 to 1.
    """
    parts = len(design.materials)
    other, which, dust, glow = rng.random((4, parts))
    base, roughness, metallic, light = zip(*design.paint.values(), strict=True)
    colour = np.array(base)
    for k, name in enumerate(design.materials):
        sold = design.others.get(name, ())
        if sold and other[k] < spread:
            colour[k] = sold[int(which[k] * len(sold))]
    dust = wear * dust
    tint, shade = spread * rng.standard_normal((parts, 3)), spread * rng.standard_normal(parts)
    colour *= np.exp(0.5 * tint + shade[:, None])
    colour = np.clip(colour * (1 - 0.5 * dust[:, None]) + 0.06 * dust[:, None], 0, 1)
    rough = np.clip(roughness + 0.5 * dust + 0.1 * rng.standard_normal(parts), 0.05, 1)
    finish = np.column_stack([rough, metallic * (1 - 0.6 * dust), 2 * glow * light])
    colours, finishes = colour.tolist(), finish.tolist()
    paint = {f"colour_{k}": colours[k] for k in range(parts)}
    return paint | {f"finish_{k}": finishes[k] for k in range(parts)}


def random_two_colours(rng: Generator, design: RobotDesign) -> dict[str, Any]:
    """Draw two colours for all parts that do not glow, as of a drone of another make.

    Parameters
    ----------
    rng
        Random generator.
    design
        Robot to paint.
    """
    parts = len(design.materials)
    two = rng.random((2, 3)) ** 2  # linear light: dark and vivid rather than pale
    shades = two[rng.integers(2, size=parts)] * rng.uniform(0.6, 1.4, (parts, 1))
    dull = (k for k, finish in enumerate(design.paint.values()) if not finish[3])
    return {f"colour_{k}": np.clip(shades[k], 0, 1).tolist() for k in dull}


def _draw_look(
    world: SceneSource, rng: Generator, tilt_rad: tuple[float, float], shutter_s: float
) -> Look:
    settings = world.settings
    name = world.lights[int(rng.integers(len(world.lights)))]
    turn = (*tilt_rad, float(rng.uniform(-np.pi, np.pi)))
    zoom = _draw_uniform(rng, settings.background_zoom)
    pasted = settings.pasted and world.photos is not None
    if world.photos is not None:
        backdrop = world.photos.random_backdrop(rng, world.camera, zoom, averaged=not pasted)
        if settings.recoloured_share and rng.random() < settings.recoloured_share:
            backdrop = backdrop[..., rng.permutation(3)]
    else:
        backdrop = world.panorama(name).render(world.camera, turn)
    backdrop = process_backdrop(settings, rng, backdrop, world.camera.fx_px * shutter_s)
    gain = _draw_log_uniform(rng, settings.robot_gain)
    if not pasted:
        backdrop = clip_highlights(backdrop)
        gain *= float(backdrop.mean()) / 0.3
    seed = int(rng.integers(2**31))
    light = _draw_light(settings, rng, name, turn, pasted=pasted)
    sensor = random_sensor(settings, rng, exposed=not pasted)
    return Look(backdrop, light, sensor, gain, _draw_uniform(rng, settings.robot_blur_px), seed)


def process_backdrop(
    settings: Settings, rng: Generator, light: FloatImage, px_per_rps: float
) -> FloatImage:
    """Return the light behind the robots with contrast, defocus and motion blur applied.

    Parameters
    ----------
    settings
        Ranges.
    rng
        Random generator.
    light
        (H, W, 3) linear light.
    px_per_rps
        Image motion during the exposure of a camera that turns by one radian per second, pixels.
    """
    if settings.background_contrast != (1.0, 1.0):
        light = stretch_contrast(light, _draw_log_uniform(rng, settings.background_contrast))
    light = gaussian_blur(light, _draw_uniform(rng, settings.background_blur_px))
    shake = rng.normal(size=2)
    shake *= np.radians(settings.shake_max_dps) * rng.random() / np.linalg.norm(shake)
    return apply_motion_blur(light, (shake * px_per_rps).tolist())


def clip_highlights(light: FloatImage) -> FloatImage:
    """Return (H, W, 3) light with suns and lamps clipped."""
    return np.minimum(light, HIGHLIGHT_LIMIT * max(float(light.mean()), 1e-3))


def _draw_light(
    settings: Settings, rng: Generator, name: str, turn: tuple[float, float, float], *, pasted: bool
) -> Light:
    towards = rng.normal((0.0, 0.0, 1.2), 1.0)
    towards = camera_from_horizontal(*turn[:2]) @ (towards / np.linalg.norm(towards))
    warm = float(rng.normal(0, 0.12))
    return Light(
        name=name,
        turn_rad=turn,
        strength=_draw_uniform(rng, settings.light_strength),
        sun_camera=BEHIND_CAMERA if pasted else towards,
        sun_strength=_draw_uniform(rng, settings.sun_strength),
        sun_colour=(1.0, 1.0, 1.0) if pasted else (1 + warm, 1.0, 1 - warm),
        sun_angle_rad=_draw_uniform(rng, (0.01, 0.6)),
        sun_shadow=not pasted,
    )


def random_sensor(settings: Settings, rng: Generator, *, exposed: bool = True) -> Sensor:
    """Draw a sensor from the ranges of the settings. Without ``exposed`` its exposure is fixed."""
    warmth = _draw_log_uniform(rng, settings.warmth) ** 0.5
    return Sensor(
        brightness=_draw_uniform(rng, settings.brightness) if exposed else None,
        contrast_gamma=_draw_uniform(rng, settings.contrast_gamma),
        balance=(warmth, 1.0, 1 / warmth),
        saturation=_draw_uniform(rng, settings.saturation),
        vignetting=_draw_uniform(rng, settings.vignetting),
        defocus_px=_draw_uniform(rng, settings.defocus_px),
        bayer=settings.bayer,
        shot_noise=_draw_uniform(rng, settings.shot_noise),
        read_noise=_draw_uniform(rng, settings.read_noise),
    )
