"""Pictures of small drones, drawn by code, with exact labels."""

from collections.abc import Iterator

import numpy as np
from numpy.random import Generator

from dmrl.formats.files.label_csv import LabelRow
from dmrl.geometry.frames import AIDECK_PINHOLE, Camera
from dmrl.images.codec import encode_png
from dmrl.rendering.sketch_renderer import Sketch, render_sketch
from dmrl.rendering.sketch_scene import random_look, random_poses
from dmrl.simulation.settings import SketchSettings


def draw_files(indices: range, settings: SketchSettings) -> list[tuple[str, bytes, list[LabelRow]]]:
    """Return the name, PNG and labels of some pictures."""
    made = []
    for index in indices:
        name, picture = f"{index:06d}.png", draw_picture(settings, index)
        labels = list(_label_rows(name, picture, _choose_split(settings, index)))
        made.append((name, encode_png(picture.rgb), labels))
    return made


def draw_picture(settings: SketchSettings, index: int, camera: Camera = AIDECK_PINHOLE) -> Sketch:
    """Draw picture number ``index``, the same whatever else is drawn.

    Parameters
    ----------
    settings
        Seed, and how many robots.
    index
        Number of the picture, from 0.
    camera
        Without distortion.
    """
    rng = np.random.default_rng((settings.seed, index))
    poses = random_poses(rng, camera, _robot_count(rng, settings))
    return render_sketch(camera, poses, random_look(rng, camera))


def _robot_count(rng: Generator, settings: SketchSettings) -> int:
    empty = rng.random() < settings.empty_share
    return 0 if empty else int(rng.integers(1, settings.robots_max + 1))


def _choose_split(settings: SketchSettings, index: int) -> str:
    first_test = settings.images - round(settings.images * settings.test_share)
    return "test" if index >= first_test else "train"


def _label_rows(name: str, picture: Sketch, split: str) -> Iterator[LabelRow]:
    if not len(picture.depth_m):
        yield LabelRow(name, "", source="truth", split=split)
    for k, ((u_px, v_px), depth_m) in enumerate(zip(picture.uv_px, picture.depth_m, strict=True)):
        box = tuple(picture.box_px[k].tolist())
        yield LabelRow(
            file=name,
            peer=f"cf{k + 2}",
            u_px=u_px,
            v_px=v_px,
            depth_m=depth_m,
            box_px=() if np.isnan(box).any() else box,
            visible_share=float(picture.visible_share[k]),
            source="truth",
            split=split,
        )
