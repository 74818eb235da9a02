"""Average precision of boxes as COCO defines it, for comparison with object detectors.

A label or a detection has a pixel and a depth, not a box. Its box is a square around the pixel, as
wide as a robot of a stated width is at that depth, clipped to the image.
"""

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import optional_imports
from dmrl.geometry.boxes import clip_box, square_box
from dmrl.geometry.frames import Camera
from dmrl.learn.inference.matching import Points
from dmrl.terminal.tables import print_line, print_table

Array = NDArray[np.float64]

CLASS_ID = 1
"""The only class: a robot."""
FIGURES = {
    "ap": ("AP", 0),
    "ap50": ("AP50", 1),
    "ap75": ("AP75", 2),
    "ap_small": ("AP small", 3),
    "ap_medium": ("AP medium", 4),
    "ap_large": ("AP large", 5),
    "ar": ("AR", 8),
}
"""Titles of the figures, and their numbers among those that pycocotools summarizes.

AP is the mean of the average precisions at intersections over union of 0.5, 0.55 to 0.95; AP50 and
AP75 are those at 0.5 and 0.75. Small boxes have less than 32 x 32 pixels, large ones more than
96 x 96. AR is the recall with at most 100 detections an image, over the same intersections.
"""


@dataclass(frozen=True, slots=True)
class BoxPrecision:
    """Average precision of boxes.

    Parameters
    ----------
    robot_width_m
        Width of the robots, metres.
    images
        Number of images.
    left_out
        Number of images that are left out, as the depth of one of their labels is unknown.
    figures
        Value of each of `FIGURES`; None where no label has that size.
    """

    robot_width_m: float
    images: int
    left_out: int
    figures: dict[str, float | None]

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON values."""
        counts = {"images": self.images, "left_out": self.left_out}
        return {"robot_width_m": self.robot_width_m, **counts, **self.figures}

    def print(self, name: str) -> None:
        """Print the figures as a table, with the name of what is judged."""
        values = ["-" if value is None else f"{value:.3f}" for value in self.figures.values()]
        title = f"{name}: {self.images} images, boxes {self.robot_width_m:g} m wide, COCO's rules"
        print_table(title, [name for name, _ in FIGURES.values()], [values])
        if self.left_out:
            print_line(f"left out: images with a label without a depth: {self.left_out}")


def compute_box_precision(
    cameras: Sequence[Camera], labels: Points, detections: Points, robot_width_m: float
) -> BoxPrecision:
    """Compute the average precision of boxes.

    Parameters
    ----------
    cameras
        Camera of each image.
    labels, detections
        Those of the images.
    robot_width_m
        Width of the robots, metres.

    Raises
    ------
    MissingExtra
        If pycocotools is not installed.
    """
    unknown = labels.image[~(labels.depth_m > 0)]
    used = np.setdiff1d(np.arange(len(cameras)), unknown)
    boxes = [
        _to_annotations(points, cameras, robot_width_m, used) for points in (labels, detections)
    ]
    figures = _evaluate_boxes(used.tolist(), *boxes)
    return BoxPrecision(robot_width_m, len(used), len(cameras) - len(used), figures)


def _to_annotations(
    points: Points, cameras: Sequence[Camera], robot_width_m: float, used: NDArray[np.int64]
) -> list[dict[str, Any]]:
    """Return labels or detections in some images as annotations of COCO."""
    shown = points.select(np.isin(points.image, used) & (points.depth_m > 0))
    columns = (shown.image, shown.u_px, shown.v_px, shown.depth_m, shown.confidence)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    found = []
    for number, (image, u_px, v_px, depth_m, score) in enumerate(rows, start=1):
        camera = cameras[image]
        box = square_box(camera, u_px, v_px, depth_m, robot_width_m)
        left, top, right, bottom = clip_box(box, camera.width_px, camera.height_px)
        width, height = right - left, bottom - top
        found.append(
            {
                **{"id": number, "image_id": image, "category_id": CLASS_ID, "iscrowd": 0},
                **{"bbox": [left, top, width, height], "area": width * height, "score": score},
            }
        )
    return found


def _evaluate_boxes(
    images: list[int], labels: list[dict[str, Any]], detections: list[dict[str, Any]]
) -> dict[str, float | None]:
    """Return the value of each of `FIGURES`."""
    with optional_imports("coco", "dmrl evaluate --robot-width-m"):
        from pycocotools.coco import COCO  # noqa: PLC0415 - an extra, for this option alone
        from pycocotools.cocoeval import COCOeval  # noqa: PLC0415

    def build(annotations: list[dict[str, Any]]) -> Any:
        one = COCO()
        one.dataset = {
            "images": [{"id": image} for image in images],
            "categories": [{"id": CLASS_ID, "name": "robot"}],
            "annotations": annotations,
        }
        one.createIndex()
        return one

    # pycocotools prints its progress.
    with redirect_stdout(io.StringIO()):
        judged = COCOeval(build(labels), build(detections), "bbox")
        judged.evaluate()
        judged.accumulate()
        judged.summarize()
    found = {name: float(judged.stats[number]) for name, (_, number) in FIGURES.items()}
    return {name: None if value < 0 else value for name, value in found.items()}
