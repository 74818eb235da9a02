"""Cut-outs: photographs of a robot, put over other images with exact labels and without Blender.

The cut-out takes over mean light, colour cast, saturation, blur and grain of the image behind it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import Generator

from dmrl.errors import SettingError, SourceError
from dmrl.geometry.frames import Camera, project
from dmrl.guards.paths import refuse_pipes
from dmrl.images.layers import decode_with_alpha, turn_and_scale
from dmrl.rendering.backgrounds.panorama import Panorama
from dmrl.rendering.backgrounds.photos import SRGB_TO_LINEAR
from dmrl.rendering.camera.distortion import FloatImage, pinhole_canvas
from dmrl.rendering.camera.image_statistics import measure_images
from dmrl.rendering.camera.sensor import LUMINANCE, gaussian_blur
from dmrl.rendering.compositing import compose_shot
from dmrl.rendering.renderer import Scene
from dmrl.rendering.shot import Layer, Robot, Shot

MIN_OPACITY = 0.5
"""Opacity from which a pixel of a cut-out is the robot, and not its shadow."""
NOMINAL_LEVEL = 0.3
"""Mean light of an image at which a cut-out keeps its own."""
FULL_COLOUR = 0.05
"""Mean difference of red and blue, share of the light, from which an image has full colours."""
SHARP_EDGE_PX = 1.7
"""Width of edges that one pixel of blur does not widen any more."""
PAD_SHARE = 0.6
"""Transparent border around a cut-out, share of its longer side, so that it turns and shifts."""


@dataclass(frozen=True, slots=True)
class Cutout:
    """Premultiplied linear light and opacity (H, W, 4), and the width of the robot, pixels."""

    light: FloatImage
    width_px: int


def load_cutout(path: Path) -> Cutout:
    """Read a PNG with alpha whose visible part is one robot.

    Raises
    ------
    SourceError
        If the file is not readable, has no alpha, or shows nothing.
    """
    levels = decode_with_alpha(path.read_bytes(), path)
    alpha = levels[..., 3:].astype(np.float32) / np.float32(255)
    solid = alpha[..., 0] >= MIN_OPACITY
    if not solid.any():
        raise SourceError(f"{path} is transparent everywhere. Cut the robot out again")
    rows, columns = np.flatnonzero(solid.any(axis=1)), np.flatnonzero(solid.any(axis=0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    light = np.concatenate([np.take(SRGB_TO_LINEAR, levels[..., :3]) * alpha, alpha], axis=2)[part]
    pad = round(PAD_SHARE * max(light.shape))
    return Cutout(np.pad(light, ((pad, pad), (pad, pad), (0, 0))), int(np.ptp(columns)) + 1)


def open_cutouts(folder: Path) -> list[Cutout]:
    """Read all cut-outs of a folder, in the order of their names.

    Raises
    ------
    SettingError
        If the folder does not exist or contains no PNG.
    SourceError
        If one is no cut-out.
    """
    if not folder.is_dir():
        raise SettingError(f"no folder {folder} of cut-outs. Check the key cutouts")
    refuse_pipes(folder)
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png")
    if not paths:
        raise SettingError(f"{folder} contains no PNG. Save robots with alpha there, or use others")
    return [load_cutout(path) for path in paths]


class CutoutRenderer:
    """Renderer of cut-outs, used in place of `dmrl.rendering.renderer.Renderer`.

    Parameters
    ----------
    cutouts
        Cut-outs, each shown equally often.
    width_m
        True width of the robot in them.
    tilt_max_deg
        Turn of a cut-out in the image, at most.
    matched
        Whether cut-outs take the mean light of the image. Without it the look says it.
    """

    version = ""

    def __init__(
        self, cutouts: list[Cutout], width_m: float, tilt_max_deg: float, *, matched: bool
    ) -> None:
        self._cutouts, self._width_m = cutouts, width_m
        self._tilt_max_deg, self._matched = tilt_max_deg, matched
        self.lights = [""]
        self.radius_m = width_m / 2

    def render_shots(self, scenes: Iterable[Scene]) -> Iterator[Shot]:
        """Yield the shots of scenes, in their order."""
        for camera, robots, look in scenes:
            rng = np.random.default_rng((look.seed, 2))
            layers = {
                k: layer
                for k, robot in enumerate(robots)
                if (layer := self._place(camera, robot, look.backdrop, rng)) is not None
            }
            yield compose_shot(camera, robots, look, layers)

    def load_panorama(self, name: str) -> Panorama:
        """Refuse: cut-outs are put over photos."""
        raise SettingError(f"cut-outs want photos behind them, not {name!r}. Use --backgrounds")

    def _place(
        self, camera: Camera, robot: Robot, backdrop: FloatImage, rng: Generator
    ) -> Layer | None:
        """Return a cut-out at a robot's place, as the backdrop's camera would show it."""
        cutout = self._cutouts[int(rng.integers(len(self._cutouts)))]
        mirrored = rng.random() < 0.5
        turn_deg = float(rng.uniform(-1, 1)) * self._tilt_max_deg
        canvas = pinhole_canvas(camera)
        uv, depth_m = project(robot.pose.xyz_camera[None], canvas.pinhole.image_from_optical)
        width_px = canvas.pinhole.fx_px * self._width_m / float(depth_m[0])
        limit = np.array([canvas.pinhole.width_px, canvas.pinhole.height_px])
        scale = cutout.width_px / width_px
        half = np.divide(cutout.light.shape[1::-1], 2 * scale)
        low = np.clip(np.ceil(uv[0] - half), 0, limit).astype(int)
        high = np.clip(np.floor(uv[0] + half), 0, limit).astype(int)
        if (low >= high).any():
            return None
        seen = cutout.light[:, ::-1] if mirrored else cutout.light
        box = ((np.stack([low, high]) - (uv[0] - half)) * scale).ravel().tolist()
        width, height = (high - low).tolist()
        light = turn_and_scale(seen, turn_deg, box, (width, height))
        light = match_backdrop(light, backdrop, rng, brightness=self._matched)
        flat = np.where(light[..., 3] > 0, np.float32(depth_m[0]), np.float32(0))
        return Layer(int(low[0]), int(low[1]), light, flat)


def match_backdrop(
    light: FloatImage, backdrop: FloatImage, rng: Generator, *, brightness: bool
) -> FloatImage:
    """Return a layer with the colours, blur and grain of the image behind it.

    Parameters
    ----------
    light
        (h, w, 4) premultiplied linear light and opacity.
    backdrop
        (H, W, 3) linear light.
    rng
        Random generator of the grain.
    brightness
        Whether to match the mean light, too.
    """
    mean = np.maximum(backdrop.mean(axis=(0, 1)), 1e-4)
    level = float(mean @ LUMINANCE)
    spread = float(np.abs(backdrop[..., 0] - backdrop[..., 2]).mean()) / level
    colourful = np.float32(min(spread / FULL_COLOUR, 1))
    rgb, alpha = light[..., :3], light[..., 3:]
    grey = (rgb @ LUMINANCE)[..., None]
    rgb = (grey + colourful * (rgb - grey)) * (mean / level).astype(np.float32)
    if brightness:
        rgb = rgb * np.float32(level / NOMINAL_LEVEL)
    levels = np.asarray(255 * np.clip(backdrop, 0, 1) ** np.float32(1 / 2.2), np.uint8)
    found = measure_images([levels]).to_statistics()
    edge_px = found.edge_px or SHARP_EDGE_PX
    blur_px = 0.4 * float(np.sqrt(max(edge_px**2 - SHARP_EDGE_PX**2, 0)))
    out = gaussian_blur(np.concatenate([rgb, alpha], axis=2), blur_px)
    value = np.clip(out[..., :3], 1e-4, None)
    grain = np.float32((found.grain or 0) / 255) * rng.standard_normal((*out.shape[:2], 1))
    # Grain is measured on stored values; light is their power of 2.2.
    out[..., :3] += out[..., 3:] * 2.2 * value ** np.float32(1.2 / 2.2) * grain.astype(np.float32)
    return np.maximum(out, 0)
