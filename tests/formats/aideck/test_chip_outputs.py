"""Confidence and depth maps that a chip wrote beside its images.

One level is 0.211 in the logit of the confidence and in the logarithm of the depth.
"""

from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl.errors import SourceError
from dmrl.formats.aideck.chip_outputs import load_chip_maps
from dmrl.images.codec import encode_png


def write_pgm(path: Path, levels: np.ndarray) -> None:
    """Write (rows, cols) signed levels as a PGM image, with 128 added."""
    rows, cols = levels.shape
    path.write_bytes(
        f"P5\n{cols} {rows}\n255\n".encode() + (levels + 128).astype(np.uint8).tobytes()
    )


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Return a folder of two images; only the second has maps."""
    folder = tmp_path / "frames"
    (folder / "gap8-maps").mkdir(parents=True)
    for number in ("00007", "00009"):
        (folder / f"img{number}.png").write_bytes(encode_png(np.zeros((24, 32, 3), np.uint8)))
    levels = np.arange(-6, 6).reshape(3, 4)
    write_pgm(folder / "gap8-maps/pos00009.ppm", levels)
    write_pgm(folder / "gap8-maps/dep00009.ppm", -levels)
    return folder


def test_chip_maps_are_probabilities_and_metres_at_image_time(frames: Path, tmp_path: Path) -> None:
    rec = dmrl.convert(frames, tmp_path / "out.mcap")
    (grid,) = rec.messages("/cf1/detections/grid")
    assert grid.time_ns == 100_000_000 and tuple(grid.message.channels) == ("confidence", "depth_m")
    values = np.frombuffer(grid.message.data, "<f4").reshape(2, 3, 4)
    levels = np.arange(-6, 6).reshape(3, 4)
    np.testing.assert_allclose(values[0], 1 / (1 + np.exp(-0.211 * levels)), rtol=1e-5)
    np.testing.assert_allclose(values[1], np.exp(-0.211 * levels), rtol=1e-5)


def test_incomplete_or_unequal_map_pairs_are_refused(frames: Path, tmp_path: Path) -> None:
    write_pgm(frames / "gap8-maps/dep00009.ppm", np.zeros((2, 4), int))
    with pytest.raises(SourceError, match=r"dep00009\.ppm differs in size"):
        dmrl.convert(frames, tmp_path / "out.mcap")
    (frames / "gap8-maps/dep00009.ppm").unlink()
    with pytest.raises(SourceError, match=r"dep00009\.ppm beside its other map"):
        dmrl.convert(frames, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_chip_maps_belong_to_the_image_of_their_name(frames: Path) -> None:
    assert load_chip_maps(frames / "img00007.png", 5, "cf7") is None
    found = load_chip_maps(frames / "img00009.png", 5, "cf7")
    assert found is not None
    assert (found.time_ns, found.topic, found.message) == (5, "/cf7/detections/grid", "GridMap")
    sizes = {name: found.fields[name] for name in ("rows", "cols", "stride_px", "channels")}
    wanted = {"rows": 3, "cols": 4, "stride_px": 8, "channels": ("confidence", "depth_m")}
    assert sizes == wanted
    confidence, depth_m = np.frombuffer(found.fields["data"], "<f4").reshape(2, 12)
    assert confidence[6] == 0.5 and depth_m[6] == 1.0
    assert confidence[0] == pytest.approx(1 / (1 + np.exp(0.211 * 6)))
    assert depth_m[0] == pytest.approx(np.exp(0.211 * 6))
