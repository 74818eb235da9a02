"""Sets of images on which the release gate evaluates a network; see `release_gate`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.formats.published.locanet import load_images
from dmrl.geometry.camera_file import find_camera
from dmrl.geometry.frames import PUBLISHED_RENDER, project
from dmrl.images.codec import Rgb, crop_and_scale, decode
from dmrl.recording import iter_columns, read
from dmrl.rendering.backgrounds.photos import SRGB_TO_LINEAR
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.cutouts import CutoutRenderer, open_cutouts
from dmrl.rendering.shot import Light, Look, Robot
from dmrl.rendering.sketch_renderer import Pose

SIZE_PX = (320, 224)
CUTOUT_WIDTH_M = 0.13
CUTOUT_WIDTHS_PX = (18.0, 110.0)
FRAMES_PX = {
    "img00185": (174, 65),
    "img00216": (152, 135),
    "img00375": (298, 138),
    "img00495": (98, 130),
}
"""Centres of the drones in the real images, read by eye."""
NO_LIGHT = Light("", (0.0, 0.0, 0.0), 0.0, np.array([-1.0, 0, 0]), 0.0, (1.0, 1.0, 1.0), 0.1)
Set = tuple[list[Rgb], list[NDArray[np.float64]]]
"""Images, and (K, 3) labels of each: u, v (pixels) and depth (metres)."""


def read_fitted(path: Path) -> Rgb:
    """Read an image, crop its middle and scale it to the input size of the networks."""
    rgb = decode(path.read_bytes(), path)
    height, width, _ = rgb.shape
    scale = min(width / SIZE_PX[0], height / SIZE_PX[1])
    half_u, half_v = SIZE_PX[0] * scale / 2, SIZE_PX[1] * scale / 2
    box = (width / 2 - half_u, height / 2 - half_v, width / 2 + half_u, height / 2 + half_v)
    return crop_and_scale(rgb, box, *SIZE_PX)


def load_published(folder: Path, *, split: str | None) -> Set:
    """Load the published renders of a split, with labels projected from the true positions."""
    found = [item for item in load_images(folder) if split is None or item.split == split]
    labels = []
    for item in found:
        uv, depth_m = project(item.xyz_camera, PUBLISHED_RENDER.image_from_optical)
        labels.append(np.column_stack([uv, depth_m]))
    return [decode(item.path.read_bytes(), item.path) for item in found], labels


def load_frames(folder: Path) -> Set:
    """Load the real images with a drone; their depths are unknown."""
    paths = sorted(path for path in folder.glob("img*.ppm") if path.stem in FRAMES_PX)
    labels = [np.array([[*FRAMES_PX[path.stem], np.nan]]) for path in paths]
    return [decode(path.read_bytes(), path) for path in paths], labels


def load_empty(folder: Path, part: str) -> Set:
    """Load the half of the real images without a drone that belongs to a part."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix in (".pgm", ".png"))
    mine = paths[0 if part == "choose" else 1 :: 2]
    return [read_fitted(path) for path in mine], [np.zeros((0, 3))] * len(mine)


def make_composites(cutouts: Path, behind: Sequence[Rgb], seed: int) -> Set:
    """Paste a cut-out on every background, twice, with exact labels."""
    camera = replace(find_camera(Path("aideck")), mount_rad=(0.0, 0.0, 0.0), delay_s=0.0)
    renderer = CutoutRenderer(open_cutouts(cutouts), CUTOUT_WIDTH_M, 15.0, matched=True)
    rng = np.random.default_rng(seed)
    scenes = []
    for frame in [*behind, *behind]:
        width_px = float(np.exp(rng.uniform(*np.log(CUTOUT_WIDTHS_PX))))
        depth_m = camera.fx_px * CUTOUT_WIDTH_M / width_px
        u, v = rng.uniform((20, 20), (300, 204))
        at = [depth_m, depth_m * (camera.cx_px - u) / camera.fx_px]
        at.append(depth_m * (camera.cy_px - v) / camera.fy_px)
        sensor, gain = Sensor(brightness=None), float(np.exp(rng.uniform(*np.log((0.4, 1.3)))))
        seed = int(rng.integers(2**31))
        look = Look(np.take(SRGB_TO_LINEAR, frame), NO_LIGHT, sensor, gain, seed=seed)
        scenes.append((camera, [Robot(Pose(np.array(at), np.eye(3)))], look))
    shots = list(renderer.render_shots(scenes))
    labels = [np.column_stack([shot.uv_px, shot.depth_m]) for shot in shots]
    return [np.asarray(shot.rgb) for shot in shots], labels


def load_renders(recording: Path) -> Set:
    """Load the images of a rendered recording, and their labels."""
    images = [decode(one.message.data, recording) for one in read(recording, "/cf1/camera/image")]
    peers = [
        row
        for batch in iter_columns(recording, "/cf1/labels", fields=["peers"])
        for row in batch["peers"].to_pylist()
    ]
    rows = [[[p["u_px"], p["v_px"], p["depth_m"]] for p in row] for row in peers]
    return images, [np.array(row, float).reshape(-1, 3) for row in rows]


def join(sets: Sequence[Set]) -> Set:
    """Concatenate some sets."""
    return [one for images, _ in sets for one in images], [row for _, rows in sets for row in rows]
