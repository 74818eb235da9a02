"""Small sets of labelled images, and the labels that are expected of them."""

from pathlib import Path
from typing import Any

import numpy as np

from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.images.codec import encode_png
from dmrl.samples.sample import Sample

WIDTH, HEIGHT = 320, 224
Boxes = list[tuple[str, tuple[float, float, float, float]]]


def make_boxes(k: int) -> Boxes:
    """Return class and edges, pixels, of the k % 3 boxes of image k."""
    rng = np.random.default_rng(k)
    found = []
    for n in range(k % 3):
        left, top = rng.uniform(2, 200), rng.uniform(2, 150)
        right, bottom = left + rng.uniform(5, 90), top + rng.uniform(5, 60)
        found.append((("drone", "quad copter")[n], (left, top, right, bottom)))
    return found


def write_picture(path: Path, k: int) -> None:
    """Write image k, all of whose pixels are k."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(np.full((HEIGHT, WIDTH, 3), k, np.uint8)))


def format_yolo(boxes: Boxes) -> str:
    """Return the lines of a YOLO label file."""
    numbers = {"drone": 0, "quad copter": 1}
    return "".join(
        f"{numbers[name]} {(a + c) / 2 / WIDTH:.6f} {(b + d) / 2 / HEIGHT:.6f} "
        f"{(c - a) / WIDTH:.6f} {(d - b) / HEIGHT:.6f}\n"
        for name, (a, b, c, d) in boxes
    )


def read_samples(source: Path, kind: str, options: Options | None = None) -> list[Sample]:
    """Return the samples of a source, whose format must be recognized as ``kind``."""
    form = find_format(source)
    assert form.name == kind
    return list(form.content(source, options or Options()).samples)


def find_labels(samples: list[Sample]) -> list[list[dict[str, Any]]]:
    """Return the labels of each labelled image."""
    return [list(s.fields["peers"]) for s in samples if s.message == "PeerLabels"]


def assert_boxes(samples: list[Sample], order: list[int], apart_px: float = 0.01) -> None:
    """Assert that the samples hold the boxes of these images, in this order."""
    found = find_labels(samples)
    assert len(found) == len(order)
    for peers, k in zip(found, order, strict=True):
        want = make_boxes(k)
        names = [name.replace(" ", "_") for name, _ in want]
        assert [peer["peer"] for peer in peers] == names
        for peer, (_, box) in zip(peers, want, strict=True):
            np.testing.assert_allclose(peer["box_px"], box, atol=apart_px)
            centre = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
            np.testing.assert_allclose((peer["u_px"], peer["v_px"]), centre, atol=apart_px)
            assert (peer["depth_m"], peer["sigma_depth_m"]) == (0, np.inf)
            assert peer["source"] == "hand"
