"""The magnified middle of images: its pixels, and the mapping of its detections."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from dmrl.deploy.c import write_c
from dmrl.deploy.image_detection import DetectionOptions
from dmrl.deploy.middle_look import magnify_middle, map_detections, map_grids
from dmrl.learn.inference.decode_grids import Detections, Grids, decode
from dmrl.simulation.eyes import NetworkEye

from .graphs import quantised_network

PIXELS = np.random.default_rng(0).integers(0, 256, (224, 320, 3), dtype=np.uint8)
SIZE_PX = (320, 224)


def build_detections(*rows: tuple[float, float, float, float]) -> Detections:
    """Return detections of one image from rows of u, v, depth and confidence."""
    u_px, v_px, depth_m, confidence = np.array(rows, float).T[:, None]
    zeros = np.zeros_like(u_px)
    count = np.array([len(rows)])
    return Detections(u_px, v_px, depth_m, confidence, 0.1 * depth_m, zeros.astype(int), count)


def test_the_middle_is_magnified_by_bilinear_interpolation() -> None:
    around = np.array([[1.5, 0.0, -80.0 + 0.25], [0.0, 1.5, -56.0 + 0.25]])
    wanted = cv2.warpAffine(PIXELS, around, SIZE_PX, flags=cv2.INTER_LINEAR)
    made = magnify_middle(PIXELS)
    assert np.abs(made.astype(int) - wanted).max() <= 1  # OpenCV rounds weights to 1/32
    np.testing.assert_array_equal(magnify_middle(PIXELS[::-1, ::-1]), made[::-1, ::-1])


def test_detections_are_mapped_to_the_whole_image() -> None:
    found = build_detections((160.0, 112.0, 0.8, 0.9), (0.0, 224.0, 0.4, 0.2))
    seen = map_detections(found, np.array([True]), SIZE_PX)
    np.testing.assert_allclose(seen.u_px, [[160.0, 320 / 6]])
    np.testing.assert_allclose(seen.v_px, [[112.0, 224 * 5 / 6]])
    np.testing.assert_allclose(seen.depth_m, [[1.2, 0.6]])
    np.testing.assert_allclose(seen.sigma_depth_m, [[0.12, 0.06]])
    same = map_detections(found, np.array([False]), SIZE_PX)
    np.testing.assert_array_equal(same.u_px, found.u_px)
    np.testing.assert_array_equal(same.depth_m, found.depth_m)


def test_near_detections_of_a_middle_are_left_out() -> None:
    found = build_detections((20.0, 20.0, 0.2, 0.9), (30.0, 30.0, 0.6, 0.5), (40.0, 40.0, 0.1, 0.3))
    seen = map_detections(found, np.array([True]), SIZE_PX)
    assert seen.count.tolist() == [1]
    assert (seen.confidence[0, 0], seen.depth_m[0, 0]) == (0.5, pytest.approx(0.9))
    assert seen.confidence[0, 1:].tolist() == [0.0, 0.0]
    assert map_detections(found, np.array([False]), SIZE_PX).count.tolist() == [3]
    (nothing,) = map_detections(
        build_detections((20.0, 20.0, 0.2, 0.9)), np.array([True]), SIZE_PX
    ).confidence
    assert nothing.tolist() == [0.0]  # an image keeps at least one detection


def test_a_peak_of_the_middle_is_in_the_cell_of_its_detection() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        grids = Grids(0.3 * rng.random((2, 28, 40)), 1 + rng.random((2, 28, 40)), None)
        row, col = int(rng.integers(28)), int(rng.integers(40))
        grids.confidence[:, row, col] = 0.9
        mapped = map_grids(grids, np.array([False, True]))
        np.testing.assert_array_equal(mapped.confidence[0], grids.confidence[0])
        both = map_detections(decode(*grids), np.array([False, True]), SIZE_PX)
        at = int(both.v_px[1, 0] // 8), int(both.u_px[1, 0] // 8)
        assert np.unravel_index(mapped.confidence[1].argmax(), (28, 40)) == at
        assert mapped.confidence[1][at] == 0.9
        assert mapped.depth_m[1][at] == pytest.approx(1.5 * grids.depth_m[1, row, col])
        assert not mapped.confidence[1][:4].any() and not mapped.confidence[1][:, :6].any()


@pytest.mark.parametrize(
    ("magnify", "magnified"), [(True, [False, True] * 2), (False, [False] * 4)]
)
def test_an_eye_magnifies_every_second_image(magnify: bool, magnified: list[bool]) -> None:
    seen: list[bool] = []

    class Detector:
        stride_px, threshold = 8, 0.5

        def grids(self, images: list[np.ndarray]) -> Grids:
            seen.append(np.array_equal(images[0], magnify_middle(PIXELS)))
            confidence = np.zeros((1, 28, 40))
            confidence[0, 14, 20] = 0.9
            return Grids(confidence, np.ones((1, 28, 40)), None)

    eye = NetworkEye(Detector(), DetectionOptions(0.01, 20, 1, magnify), None)  # type: ignore[arg-type]
    depths = [
        eye(None, 0.1 * k, PIXELS).detections["detections"][0]["depth_m"]  # type: ignore[arg-type]
        for k in range(4)
    ]
    assert seen == magnified
    assert depths == [pytest.approx(1.5 if one else 1.0) for one in magnified]


@pytest.mark.heavy
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize("channels", [1, 3])
def test_the_c_magnifies_and_maps_like_the_reference(channels: int, tmp_path: Path) -> None:
    network = next(n for n in map(quantised_network, range(20)) if n.channels == channels)
    write_c(network, tmp_path, [])
    line = ["gcc", "-std=c99", "-shared", "-fPIC", "-O1", "random.c", "-o", "random.so"]
    subprocess.run(line, cwd=tmp_path, check=True)
    code = ctypes.CDLL(str(tmp_path / "random.so"))
    high, wide = network.height_px, network.width_px
    image = np.random.default_rng(2).integers(0, 256, (high, wide, channels), dtype=np.uint8)
    out = np.zeros_like(image)
    for row in range(high):
        code.random_middle_row(image.ctypes, row, out[row].ctypes)
    np.testing.assert_array_equal(out, magnify_middle(image))

    class Found(ctypes.Structure):
        _fields_ = [
            ("u_q4", ctypes.c_int32),
            ("v_q4", ctypes.c_int32),
            ("depth_mm", ctypes.c_uint16),
            ("confidence", ctypes.c_uint16),
            ("confidence_step", ctypes.c_int8),
        ]

    rows = [(0, 16 * high, 65535), (9, 9, 260), (16 * wide, 0, 333), (5, 77, 1200)]
    found = (Found * 4)(*(Found(*row, 0, 0) for row in rows))
    assert code.random_from_middle(found, 4) == 3
    wanted = map_detections(
        build_detections(*((u / 16, v / 16, d / 1000, 0.5) for u, v, d in rows)),
        np.array([True]),
        (wide, high),
    )
    assert wanted.count.tolist() == [3]
    for k, one in enumerate(found[:3]):
        assert one.u_q4 / 16 == pytest.approx(wanted.u_px[0, k], abs=0.03)
        assert one.v_q4 / 16 == pytest.approx(wanted.v_px[0, k], abs=0.03)
        assert one.depth_mm / 1000 == pytest.approx(min(wanted.depth_m[0, k], 65.535), abs=6e-4)
