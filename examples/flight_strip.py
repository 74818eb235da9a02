"""Animate a flight: the follower's images with its detections, and both paths from above.

Run python flight_strip.py FLIGHT.mcap OUT.webp; without arguments it flies three seconds first.
"""

import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from dmrl import recipe, topics
from dmrl.recording import read, read_table
from dmrl.simulation.settings import FlyFlags
from dmrl.stages import fly

SIDE_PX, METRES = 224, 5.0
EVERY = 5  # Draw one image in five.


def draw_image(data: bytes, found: Sequence[Any], threshold: float) -> Image.Image:
    """Return the image with a circle around each detection at or above the threshold."""
    picture = Image.open(io.BytesIO(data)).convert("RGB")
    pen = ImageDraw.Draw(picture)
    for one in found:
        if one.confidence >= threshold:
            r = 12
            box = (one.u_px - r, one.v_px - r, one.u_px + r, one.v_px + r)
            pen.ellipse(box, outline="lime", width=2)
    return picture


def draw_paths(paths: dict[str, np.ndarray]) -> Image.Image:
    """Return a picture of the paths (N, 2) of both drones from above, in metres."""
    picture = Image.new("RGB", (SIDE_PX, SIDE_PX), "white")
    pen = ImageDraw.Draw(picture)
    for (_, xy), colour in zip(sorted(paths.items()), ("seagreen", "firebrick"), strict=True):
        px = SIDE_PX / 2 + np.column_stack([xy[:, 0], -xy[:, 1]]) * SIDE_PX / METRES
        pen.line([tuple(p) for p in px.tolist()], fill=colour, width=2)
        u, v = px[-1].tolist()
        pen.ellipse((u - 4, v - 4, u + 4, v + 4), fill=colour)
    return picture


def read_paths(flight: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times (N,) in ns and the true positions (N, 2) of each drone, in metres."""
    times, places = [], {"cf1": [], "cf2": []}
    for stamped in read(flight, "/tf"):
        moved = {t.child_frame_id: t.translation for t in stamped.message.transforms}
        for robot, path in places.items():
            at = moved[f"{robot}/horizontal"]
            path.append((at.x, at.y))
        times.append(stamped.time_ns)
    return np.array(times), {robot: np.array(path) for robot, path in places.items()}


def draw_strip(flight: Path, out: Path) -> int:
    """Write the animation of a flight; return its number of images."""
    times, paths = read_paths(flight)
    detections = {s.time_ns: s.message for s in read(flight, topics.DETECTIONS("cf1"))}
    frames = []
    for stamped in list(read(flight, topics.CAMERA_IMAGE("cf1")))[::EVERY]:
        said = detections.get(stamped.time_ns)
        frame = Image.new("RGB", (320 + SIDE_PX, SIDE_PX))
        found, threshold = (said.detections, said.threshold) if said else ((), 1.0)
        frame.paste(draw_image(stamped.message.data, found, threshold), (0, 0))
        count = max(int(np.searchsorted(times, stamped.time_ns)), 1)
        frame.paste(draw_paths({robot: xy[:count] for robot, xy in paths.items()}), (320, 0))
        frames.append(frame)
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=250, loop=0, quality=40)
    return len(frames)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        made, strip = Path("flight.mcap"), Path("strip.webp")
        flags = FlyFlags(eye="ideal", camera_renderer="sketch", duration_s=3.0)
        fly.run(made, recipe.load("fly_follow", "fly", fly.Settings, flags))
    else:
        made, strip = Path(sys.argv[1]), Path(sys.argv[2])
    commands = read_table(made, topics.COMMAND("cf1")).num_rows
    print(f"{strip}: {draw_strip(made, strip)} images, {commands} commands")
