"""Augmentation: new training images from existing ones, with transformed labels.

An image consists of layers. A layer shows a window of one source image (rotated, mirrored, zoomed)
in a rectangle of the canvas: the whole canvas, a tile of a mosaic, or a patch around one robot.
Each layer is sampled once.

With fixed intrinsics, a robot appears z times as large at 1/z of its distance, so a zoom by z
divides the depth by z. A rotation about the optical axis keeps the depth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from dmrl.learn.data import crops
from dmrl.learn.data.batches import BOX, DEPTH, ROBOT_FIELDS, Batch, ExampleSet, U, V
from dmrl.learn.data.crops import (
    CropWindow,
    Opacity,
    Pixels,
    Point,
    Rect,
    Rng,
    RobotRow,
    StepMatrix,
)

MAX_ROBOTS_PER_IMAGE = 12
"""Maximum number of labelled robots in one image."""
PATCH_MARGIN = 1.25
"""Side of a pasted patch over the side of the robot's box."""
DISTRACTOR_FRACTION = 0.4
"""Fraction of patches that show a random position of a random image."""
FOCUS_FRACTION = 0.8
"""Fraction of windows that contain a robot of their image; the others are placed at random."""
MIN_DEPTH_RATIO = 0.25
"""Minimum ratio of smallest to largest depth, along the source's axis, over a rotated view's
corners."""
DEPTH_RANGE_FACTOR = 1.1
"""Factor by which zooming may move a robot beyond the nearest and the farthest label."""


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Settings of the augmentation. All zero: none.

    Parameters
    ----------
    flip_share
        Probability of a left-right mirrored window.
    zoom
        Smallest and largest magnification of a window. It is also limited so that the robot's depth
        stays in the range of the labels.
    rotation_deg
        Largest rotation about the optical axis, either way.
    mosaic_share
        Probability that an image is a mosaic of two or four windows.
    paste
        Mean number of patches of other images pasted into one, most of them around a robot.
    colour
        Spread (one sigma) of contrast, brightness and each channel's gain, 0 to 1.
    noise
        Largest sigma of sensor noise, 0 to 1 of full scale.
    blur_share
        Probability of a slight defocus.
    intrinsics
        Intrinsics of the camera, undistorted. With them, a window is the view of a rotated camera;
        without, it is a crop.
    grey_share
        Probability that the three channels become their luma, as of a grey camera.
    """

    flip_share: float = 0.0
    zoom: tuple[float, float] = (1.0, 1.0)
    rotation_deg: float = 0.0
    mosaic_share: float = 0.0
    paste: float = 0.0
    colour: float = 0.0
    noise: float = 0.0
    blur_share: float = 0.0
    intrinsics: crops.Intrinsics | None = None
    grey_share: float = 0.0

    @property
    def without_geometry(self) -> "Augmentation":
        """The same without zoom, rotation, mosaic and pasted patches."""
        return replace(self, zoom=(1.0, 1.0), rotation_deg=0.0, mosaic_share=0.0, paste=0.0)

    @property
    def is_identity(self) -> bool:
        """Whether images stay unchanged."""
        return self == Augmentation()


class Augmenter:
    """Generator of augmented batches from one set of examples.

    Parameters
    ----------
    examples
        Source images.
    settings
        Settings of the augmentation.
    seed
        Seed. A batch depends only on the seed, the epoch and its index in the epoch.
    """

    def __init__(self, examples: ExampleSet, settings: Augmentation, *, seed: int) -> None:
        self._examples, self._settings, self._seed = examples, settings, seed
        self._height, self._width, _ = examples.image_shape
        robots = examples.robots
        there = np.isfinite(robots[..., U])
        depths = robots[..., DEPTH][there & (robots[..., DEPTH] > 0)]
        self._depths = (
            (float(depths.min()) / DEPTH_RANGE_FACTOR, float(depths.max()) * DEPTH_RANGE_FACTOR)
            if len(depths)
            else (0.0, math.inf)
        )
        self._pasteable = np.argwhere(there & np.isfinite(robots[..., BOX]).all(axis=-1))
        numbers = 2 * self._height * self._width * 3 if settings.noise else 0
        self._grain = np.random.default_rng([seed, 1]).standard_normal(numbers, np.float32)

    def augment_batch(
        self, chosen: Sequence[int] | NDArray[np.int64], *, epoch: int, index: int
    ) -> Batch:
        """Return an augmented batch: one canvas for each of the chosen images.

        Parameters
        ----------
        chosen
            Indices of images.
        epoch, index
            Epoch, and index of the batch in it.
        """
        self._examples.require_whole()
        rng = np.random.default_rng([self._seed, epoch, index])
        canvas = np.empty((len(chosen), self._height, self._width, 3), np.uint8)
        robots = np.full((len(chosen), MAX_ROBOTS_PER_IMAGE, len(ROBOT_FIELDS)), np.nan, np.float32)
        for slot, number in enumerate(chosen):
            if found := self._draw_canvas(canvas[slot], int(number), rng)[:MAX_ROBOTS_PER_IMAGE]:
                robots[slot, : len(found)] = found
        return Batch(torch.from_numpy(canvas).permute(0, 3, 1, 2), torch.from_numpy(robots))

    def _draw_canvas(self, canvas: Pixels, number: int, rng: Rng) -> list[RobotRow]:
        """Draw a canvas (H, W, 3) and return its robots."""
        robots: list[RobotRow] = []
        whole = (0, 0, self._width, self._height)
        mosaic = rng.random() < self._settings.mosaic_share
        rects = crops.tile_mosaic(whole, rng) if mosaic else [whole]
        others = rng.integers(len(self._examples), size=len(rects) - 1)
        for rect, source in zip(rects, (number, *others.tolist()), strict=True):
            robots = self._draw_layer(canvas, rect, source, robots, rng)
        for _ in range(int(rng.poisson(self._settings.paste))):
            robots = self._paste_patch(canvas, robots, rng)
        self._degrade_image(canvas, rng)
        return robots

    def _draw_layer(
        self, canvas: Pixels, rect: Rect, source: int, robots: list[RobotRow], rng: Rng
    ) -> list[RobotRow]:
        """Draw a window of a source in a rectangle; return the robots of the canvas after it."""
        width, height = rect[2] - rect[0], rect[3] - rect[1]
        mine = crops.list_robots(self._examples.robots[source])
        focus = mine[int(rng.integers(len(mine)))] if mine else None
        zoom = self._sample_zoom(focus, rng)
        zoom = max(zoom, width / self._width, height / self._height)  # stay inside the source
        held = focus if focus and rng.random() < FOCUS_FRACTION else None
        seen = (
            _sample_centre(self._width, width / (2 * zoom), held[U] if held else None, rng),
            _sample_centre(self._height, height / (2 * zoom), held[V] if held else None, rng),
        )
        shown = (width / 2, height / 2)
        turn = self._sample_rotation(zoom, rng)
        if focus:  # the camera rotation is exact at the robot's new position
            at = _step_to_canvas(turn, focus[U] - seen[0], focus[V] - seen[1])
            at = (at[0] + shown[0], at[1] + shown[1])
            if 0 <= at[0] < width and 0 <= at[1] < height:
                seen, shown = (focus[U], focus[V]), at
        window = self._build_window(turn, zoom, seen, shown, rect)
        return self._render_window(canvas, rect, source, window, mine, robots, rng)

    def _paste_patch(self, canvas: Pixels, robots: list[RobotRow], rng: Rng) -> list[RobotRow]:
        """Paste a robot of another image, or sometimes a patch without one.

        The patch follows the robot's mask if there is one, else a box with a feathered border.
        Patches without a robot are needed: otherwise the edge of a patch would reveal a robot.
        """
        if not len(self._pasteable):
            return robots
        source, which = self._pasteable[rng.integers(len(self._pasteable))].tolist()
        robot: RobotRow = self._examples.robots[source, which].tolist()
        zoom = self._sample_zoom(robot, rng)
        west, north, east, south = robot[BOX]
        width = math.ceil(zoom * PATCH_MARGIN * (east - west)) + 8
        height = math.ceil(zoom * PATCH_MARGIN * (south - north)) + 8
        if width > self._width or height > self._height:
            return robots
        left = int(rng.uniform(0, self._width - width + 1))
        top = int(rng.uniform(0, self._height - height + 1))
        rect, shown = (left, top, left + width, top + height), (width / 2, height / 2)
        mask = self._examples.get_mask(source, which)
        middle = ((west + east) / 2 + rng.uniform(-2, 2), (north + south) / 2 + rng.uniform(-2, 2))
        centre = middle
        if rng.random() < DISTRACTOR_FRACTION:
            source = int(rng.integers(len(self._examples)))
            centre = (rng.uniform(0, self._width), rng.uniform(0, self._height))
        turn = self._sample_rotation(zoom, rng)
        window = self._build_window(turn, zoom, centre, shown, rect)
        opacity = crops.build_feather_mask(height, width)
        if mask is not None:
            about = self._build_window(turn, zoom, middle, shown, rect)
            cut = crops.sample_window(255 * mask, about, (height, width), sharp=False)
            opacity = np.asarray(cut / np.float32(255), np.float32)
        mine = crops.list_robots(self._examples.robots[source])
        return self._render_window(canvas, rect, source, window, mine, robots, rng, opacity)

    def _sample_zoom(self, robot: RobotRow | None, rng: Rng) -> float:
        """Sample a log-uniform magnification; the depth stays in the range of the labels."""
        low, high = self._settings.zoom
        if robot is not None and robot[DEPTH] > 0:
            depth_m = robot[DEPTH]
            low = max(low, min(depth_m / self._depths[1], 1.0))
            high = max(min(high, max(depth_m / self._depths[0], 1.0)), low)
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    def _sample_rotation(self, zoom: float, rng: Rng) -> StepMatrix:
        """Sample the (2, 2) matrix from steps on the canvas to steps in the source."""
        most = math.radians(self._settings.rotation_deg)
        angle = rng.uniform(-most, most)
        mirror = -1.0 if rng.random() < self._settings.flip_share else 1.0
        along, across = math.cos(angle) / zoom, math.sin(angle) / zoom
        return (mirror * along, -across), (mirror * across, along)

    def _build_window(
        self, turn: StepMatrix, zoom: float, seen: Point, shown: Point, rect: Rect
    ) -> CropWindow:
        """Build the window of a rectangle that maps a source point to one of its points."""
        camera = self._settings.intrinsics
        if camera:
            matrix = crops.build_rotation_homography(camera, turn, seen, shown, (rect[0], rect[1]))
            x, y, whole = matrix[2].tolist()
            right, down = x * (rect[2] - rect[0]), y * (rect[3] - rect[1])
            ahead = (whole, whole + right, whole + down, whole + right + down)
            if min(ahead) > MIN_DEPTH_RATIO * max(ahead):
                return CropWindow(matrix, zoom, camera)
        return CropWindow(crops.build_crop_homography(turn, seen, shown), zoom)

    def _render_window(
        self,
        canvas: Pixels,
        rect: Rect,
        source: int,
        window: CropWindow,
        mine: list[RobotRow],
        robots: list[RobotRow],
        rng: Rng,
        opacity: Opacity | None = None,
    ) -> list[RobotRow]:
        """Render a window into the canvas; return the robots that are then visible."""
        left, top, right, bottom = rect
        image = self._examples.get_image(source)
        pixels = crops.sample_window(image, window, (bottom - top, right - left))
        pixels = self._jitter_colours(pixels, rng)
        place = canvas[top:bottom, left:right]
        place[:] = pixels if opacity is None else crops.alpha_blend(place, pixels, opacity)
        whole = (0, 0, self._width, self._height)
        new = crops.move_labels(
            [robot for robot in mine if crops.is_inside(robot, whole)], window, rect
        )
        kept = [robot for robot in robots if not crops.is_covered(robot, rect, opacity)]
        return kept + [robot for robot in new if crops.is_covered(robot, rect, opacity)]

    def _jitter_colours(self, pixels: Pixels, rng: Rng) -> Pixels:
        """Return the pixels with random contrast, brightness and white balance."""
        spread = self._settings.colour
        if not spread:
            return pixels
        contrast, *white, light = rng.normal(0, spread, 5).tolist()
        gain = [math.exp(contrast + channel / 2) for channel in white]
        return crops.scale_channels(pixels, gain, [128 * (1 - times + light) for times in gain])

    def _degrade_image(self, canvas: Pixels, rng: Rng) -> None:
        """Apply defocus, sensor noise and loss of colours, in place."""
        if rng.random() < self._settings.blur_share:
            canvas[:] = crops.blur_pixels(canvas, rng.uniform(0.1, 1 / 3))
        if self._settings.noise:
            at = int(rng.integers(len(self._grain) - canvas.size))
            grain = self._grain[at : at + canvas.size]
            canvas[:] = crops.add_noise(canvas, grain, 255 * self._settings.noise * rng.random())
        if self._settings.grey_share and rng.random() < self._settings.grey_share:
            canvas[:] = crops.to_luma(canvas)


def _sample_centre(whole: float, half: float, held: float | None, rng: Rng) -> float:
    """Sample the centre of a window along an axis, given its half size.

    The window stays inside the image and, where ``held`` is a position, contains it.
    """
    low, high = half, max(whole - half, half)
    if held is not None:
        low, high = (min(max(held + far, low), high) for far in (-half, half))
    return float(rng.uniform(low, high))


def _step_to_canvas(turn: StepMatrix, right: float, down: float) -> Point:
    """Return a step in the source as a step on the canvas."""
    (a, b), (c, d) = turn
    area = a * d - b * c
    return (d * right - b * down) / area, (a * down - c * right) / area
