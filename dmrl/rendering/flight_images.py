"""Rendered images of simulated flights, with a constant appearance per flight.

A flight takes place in one panorama under one sun. Every robot keeps its colours and every
camera its sensor for the whole flight.
"""

from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import numpy as np

from dmrl.geometry.frames import Array, Camera
from dmrl.rendering.backgrounds.photos import apply_motion_blur
from dmrl.rendering.camera.distortion import FloatImage
from dmrl.rendering.camera.sensor import gaussian_blur
from dmrl.rendering.onboard_camera import CameraView
from dmrl.rendering.randomise import HIGHLIGHT_LIMIT, random_paint, random_sensor
from dmrl.rendering.renderer import Renderer, Scene
from dmrl.rendering.robots.crazyflie import CRAZYFLIE
from dmrl.rendering.settings import PRESETS, Settings
from dmrl.rendering.shot import Light, Look, Robot, Shot

ROBOT_GAIN = 0.6
"""Light of the robots relative to the panorama. Robots fly where lamps are above and behind."""
NOMINAL_LEVEL = 0.3
"""Level of a panorama at which the gain applies as it is."""


def himax_settings() -> Settings:
    """Return the settings of the AI-deck's camera."""
    keys: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in PRESETS["himax"].items()
    }
    return Settings(**keys)


class FlightRenderer:
    """Render the images of one flight.

    Parameters
    ----------
    renderer
        Renders the robots.
    seed
        Seed of the flight. Selects the panorama, the colours and the cameras.
    """

    def __init__(self, renderer: Renderer, seed: int) -> None:
        self._renderer, self._seed = renderer, seed
        self._settings = himax_settings()
        rng = np.random.default_rng((seed, 0))
        self._place = renderer.lights[int(rng.integers(len(renderer.lights)))]
        self._panorama = renderer.load_panorama(self._place)
        self._turn_rad = float(rng.uniform(-np.pi, np.pi))
        self._level = _ambient_level(self._panorama.light)
        towards = rng.normal((0.0, 0.0, 1.2), 1.0)
        self._sun_world = towards / np.linalg.norm(towards)
        self._sun: dict[str, Any] = {
            "strength": float(rng.uniform(*self._settings.light_strength)),
            "sun_strength": float(rng.uniform(*self._settings.sun_strength)),
            "sun_colour": (1.0, 1.0, 1.0),
            "sun_angle_rad": float(rng.uniform(0.05, 0.6)),
        }
        self._paint = cache(self._draw_paint)

    def __call__(self, camera: Camera, views: Iterable[CameraView]) -> Iterator[Shot]:
        """Yield the shots of one robot's views, in their order."""
        return self._renderer.render_shots(self._build_scene(camera, view) for view in views)

    def _draw_paint(self, name: str) -> dict[str, Any]:
        """Return the colours of a robot."""
        rng = np.random.default_rng((self._seed, 1, *name.encode()))
        wear = float(rng.uniform(*self._settings.wear))
        return random_paint(rng, CRAZYFLIE, wear, self._settings.colour_spread)

    def _build_scene(self, camera: Camera, view: CameraView) -> Scene:
        seed, number, _ = view.key
        ranges = self._settings
        rng = np.random.default_rng((seed, 2, number))  # the same for all images of a camera
        sensor = random_sensor(ranges, rng)
        soft_px = float(rng.uniform(*ranges.background_blur_px))
        shutter_s = float(rng.uniform(*ranges.shutter_s))
        rng = np.random.default_rng(view.key)
        here = view.here
        turn = (here.roll_rad, here.pitch_rad, here.yaw_rad + self._turn_rad)
        backdrop = gaussian_blur(self._panorama.render(camera, turn), soft_px)
        move_px = view.turning_rps * (camera.fx_px, camera.fy_px) * shutter_s
        backdrop = apply_motion_blur(
            np.minimum(backdrop, HIGHLIGHT_LIMIT * self._level), move_px.tolist()
        )
        towards = here.body_from_world @ self._sun_world
        light = Light(name=self._place, turn_rad=turn, sun_camera=towards, **self._sun)
        gain = ROBOT_GAIN * self._level / NOMINAL_LEVEL
        look = Look(backdrop, light, sensor, gain, seed=int(rng.integers(2**31)))
        robots = [
            Robot(
                pose,
                self._paint_with_rotors(name, rng, shutter_s),
                view.velocity_mps[name] * shutter_s,
            )
            for name, pose in view.poses.items()
        ]
        return camera, robots, look

    def _paint_with_rotors(
        self, name: str, rng: np.random.Generator, shutter_s: float
    ) -> dict[str, Any]:
        """Return a robot's paint with the rotor angles of one image."""
        turns = float(rng.uniform(*self._settings.rotor_speed_rps)) * shutter_s
        first = float(rng.uniform(0, np.pi))
        return self._paint(name) | {"rotor_first_rad": first, "rotor_sweep_rad": 2 * np.pi * turns}


def _ambient_level(panorama: FloatImage) -> float:
    """Return the mean light of a panorama near the horizon, with lamps clipped."""
    rows = len(panorama)
    band: Array = panorama[rows // 3 : 2 * rows // 3].astype(float)
    return max(float(np.minimum(band, HIGHLIGHT_LIMIT * band.mean()).mean()), 1e-3)
