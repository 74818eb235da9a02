"""Compare renders with the published images at the same poses.

    python benchmarks/bench_likeness.py DATA/locanet-synthetic [--model crazyflie-published.blend]
        [--images 60] [--plot OUT.jpg] [--renders RENDERS.mcap]

Every published image comes with the pose of its drone. The drone is removed from the image by
OpenCV's inpainting and rendered again in its place. The table gives the mean absolute difference of
luma and of both colour channels, of 256 levels, where the drone is. Part of it comes from
inpainting errors in the gaps of the drone, so each row changes one setting for comparison. Without
a model there is one row, with the violet robot of dmrl.

With ``--renders`` a second table compares the sharpness of whole images: mean differences between a
pixel and its right neighbour, and between a pixel and the mean of its four neighbours.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dmrl.formats.published.locanet import LocanetImage, load_images
from dmrl.geometry.frames import PUBLISHED_RENDER
from dmrl.images.codec import Rgb, decode, encode_jpeg
from dmrl.recording import read as read_messages
from dmrl.rendering.backgrounds.photos import SRGB_TO_LINEAR
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.randomise import random_paint
from dmrl.rendering.renderer import Renderer, RobotModel
from dmrl.rendering.robots.violet import VIOLET
from dmrl.rendering.shot import Light, Look, Robot, Shot
from dmrl.rendering.sketch_renderer import Pose
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_table

SCALE = 0.002
DRAWN_SCALE = 2.0
YAW_OF_MODEL_RAD = np.radians(270.0)  # x is forward in dmrl; the authors' model faces sideways
LUMA = np.array([[0.299, 0.587, 0.114], [-0.1687, -0.3313, 0.5], [0.5, -0.4187, -0.0813]])
AROUND_PX = 3
IMAGES = "/cf1/camera/image"
LIGHT = Light("", (0.0, 0.0, 0.0), 0.12, np.array([-1.0, 0, 0]), 1.7, (1.0, 1.0, 1.0), 0.19, False)
LOOK = Look(np.zeros((224, 320, 3), np.float32), LIGHT, Sensor(brightness=None), robot_blur_px=0.45)


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to render: its name, model, light and blur."""

    name: str
    model: RobotModel
    light: Light = LIGHT
    blur_px: float = 0.45


def list_variants(path: Path | None) -> list[Variant]:
    """Return the preset and changes of one setting; without a model, dmrl's own robot."""
    if path is None:
        return [Variant("drawn by dmrl", RobotModel(None, DRAWN_SCALE, design=VIOLET))]
    model = RobotModel(path, SCALE, "y", "origin")
    scene = replace(LIGHT, sun_camera=np.array([0.3, 0.3, 0.9]), sun_shadow=True)
    return [
        Variant("as published", model),
        Variant("about the middle of its box", replace(model, centre="box")),
        Variant("5 % smaller", replace(model, scale=0.95 * SCALE)),
        Variant("5 % larger", replace(model, scale=1.05 * SCALE)),
        Variant("with shadows", model, replace(LIGHT, sun_shadow=True)),
        Variant("lit from above, with shadows", model, scene),
        Variant("not blurred", model, blur_px=0.0),
        Variant("blurred by 0.8 px", model, blur_px=0.8),
    ]


def build_robot(item: LocanetImage) -> Robot:
    """Return the drone of a published image, at its pose."""
    tilt = Rotation.from_euler("XY", (item.roll_rad, item.pitch_rad))
    roll, pitch, yaw = item.attitude_rad[0]
    body = Rotation.from_euler("XZY", (roll, yaw, pitch))
    turn = tilt.inv() * body * Rotation.from_euler("Z", YAW_OF_MODEL_RAD)
    paint = random_paint(np.random.default_rng(0), VIOLET, 0.0, 0.0)
    return Robot(Pose(item.xyz_camera[0], turn.as_matrix()), paint)


def build_mask(shot: Shot) -> NDArray[np.uint8]:
    """Return an (H, W) mask, 1 on the drone and `AROUND_PX` pixels around it."""
    size = 2 * AROUND_PX + 1
    there = (shot.opacity[0] > 0).astype(np.uint8)
    return np.asarray(cv2.dilate(there, np.ones((size, size), np.uint8)), np.uint8)


def render_again(
    items: list[LocanetImage], pictures: list[Rgb], variant: Variant, masks: list[NDArray[np.uint8]]
) -> Iterator[Shot]:
    """Yield each drone rendered over its image, from which the drone under the mask is removed."""
    with Renderer(ensure_environment(say), variant.model, samples=16) as renderer:
        light = replace(variant.light, name=renderer.lights[0])
        look = replace(LOOK, light=light, robot_blur_px=variant.blur_px)
        backs = (
            SRGB_TO_LINEAR[cv2.inpaint(rgb, mask, 3, cv2.INPAINT_TELEA)]
            if len(masks)
            else look.backdrop
            for rgb, mask in zip(pictures, masks or pictures, strict=True)
        )
        scenes = zip(items, backs, strict=True)
        yield from renderer.render_shots(
            (PUBLISHED_RENDER, [build_robot(item)], replace(look, backdrop=back))
            for item, back in scenes
        )


def main() -> None:
    """Print the tables, and draw a sheet with --plot."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--renders", type=Path)
    args = parser.parse_args()
    items = [item for item in load_images(args.data) if item.split == "train"]
    chosen = np.random.default_rng(0).permutation(len(items))[: args.images]
    items = [items[k] for k in chosen]
    pictures = [decode(item.path.read_bytes(), item.path) for item in items]
    ways = list_variants(args.model)
    masks = [build_mask(shot) for shot in render_again(items, pictures, ways[0], [])]
    rows, shown = [], []
    for way in ways:
        off = []
        for rgb, mask, shot in zip(
            pictures, masks, render_again(items, pictures, way, masks), strict=True
        ):
            again = decode(encode_jpeg(shot.rgb, 90, subsampled=True), "render")
            difference = (again.astype(float) - rgb) @ LUMA.T
            off.append(np.abs(difference)[mask > 0].mean(axis=0))
            if way is ways[0]:
                shown.append((rgb, again, mask))
        means = [round(float(value), 2) for value in np.mean(off, axis=0)]
        rows.append((way.name, means[0], means[1], means[2]))
    print_table(f"{len(items)} images", ("variant", "luma", "blue", "red"), rows)
    if args.plot:
        args.plot.write_bytes(draw_sheet(shown))
    if args.renders:
        rendered = (decode(one.message.data) for one in read_messages(args.renders, IMAGES))
        compared = {"published": pictures, "renders": list(islice(rendered, len(pictures)))}
        sharp = [(name, *measure_sharpness(images)) for name, images in compared.items()]
        print_table("", ("images", "to the right pixel", "to the mean of four"), sharp)


def measure_sharpness(pictures: list[Rgb]) -> tuple[float, float]:
    """Return mean luma differences to the right pixel, and to the mean of the four neighbours."""
    luma = np.array([rgb @ LUMA[0] for rgb in pictures])
    around = luma[:, :-2, 1:-1] + luma[:, 2:, 1:-1] + luma[:, 1:-1, :-2] + luma[:, 1:-1, 2:]
    return (
        round(float(np.abs(np.diff(luma, axis=2)).mean()), 2),
        round(float(np.abs(luma[:, 1:-1, 1:-1] - around / 4).mean()), 2),
    )


def draw_sheet(shown: list[tuple[Rgb, Rgb, NDArray[np.uint8]]], columns: int = 6) -> bytes:
    """Return a JPEG of published and rendered images side by side, cropped to the drone."""
    tiles = []
    for rgb, again, mask in shown[: 4 * columns]:
        left, top, width, height = cv2.boundingRect(mask)
        part = np.s_[top : top + height, left : left + width]
        both = (cv2.resize(one[part], (150, 110), interpolation=0) for one in (rgb, again))
        tiles.append(np.hstack(list(both)))
    lines = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
    return encode_jpeg(np.vstack(lines), 90)


if __name__ == "__main__":
    main()
