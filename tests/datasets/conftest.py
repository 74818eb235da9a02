"""Small recordings with images and labels, built in code."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.topics import CAMERA_IMAGE, LABELS

HEIGHT_PX, WIDTH_PX = 48, 64
STEP_NS = 100_000_000

Record = Callable[..., Path]


def draw_noise(seed: int, height_px: int = HEIGHT_PX, width_px: int = WIDTH_PX) -> Any:
    """Draw a noise image (height, width, 3) with a black last row, to test trailing zeros."""
    rgb = np.random.default_rng(seed).integers(0, 256, (height_px, width_px, 3), np.uint8)
    rgb[-1] = 0
    return rgb


def build_peer(**fields: Any) -> Any:
    """Build one peer of PeerLabels; without ``fields`` it lies inside the image."""
    values = {"peer": "cf2", "u_px": 20.5, "v_px": 12.5, "depth_m": 1.5, "source": "truth"}
    return message_class("PeerLabel")(**{**values, **fields})


def make_recorder(folder: Path) -> Record:
    """Return a function that writes a recording of images and labels into a folder.

    ``peers`` has the list of peers of each image, None for an image without labels.
    """

    def write(
        name: str = "flight.mcap",
        peers: Sequence[Sequence[Any] | None] = ([build_peer()],) * 6,
        *,
        seed: int = 0,
        split: Mapping[str, str] | None = None,
        sizes_px: Mapping[int, tuple[int, int]] | None = None,
        masks: Mapping[int, Any] | None = None,
        begin_ns: int = 0,
        jpeg: bool = False,
    ) -> Path:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        with RecordingWriter(path, Provenance("test", {"seed": seed})) as sink:
            if split is not None:
                sink.add_metadata("dmrl.split", dict(split))
            for k, listed in enumerate(peers):
                size_px = (sizes_px or {}).get(k, (HEIGHT_PX, WIDTH_PX))
                at = begin_ns + k * STEP_NS
                rgb = draw_noise(1000 * seed + k, *size_px)
                data = encode_jpeg(rgb, 80) if jpeg else encode_png(rgb)
                kind = "jpeg" if jpeg else "png"
                picture = message_class("CompressedImage")(data=data, format=kind)
                sink.write(at, CAMERA_IMAGE("cf1"), picture)
                if k in (masks or {}):
                    covered = message_class("CompressedImage")(
                        data=encode_png(masks[k]), format="png"
                    )
                    sink.write(at, topics.MASKS("cf1"), covered)
                if listed is not None:
                    sink.write(at, LABELS("cf1"), message_class("PeerLabels")(peers=listed))
        return path

    return write


@pytest.fixture
def record(tmp_path: Path) -> Record:
    """Return a function that writes recordings into the test's own folder."""
    return make_recorder(tmp_path)
