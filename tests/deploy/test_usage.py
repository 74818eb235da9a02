"""The example programs in every export compile, run and give the same detections."""

import py_compile
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl.cli import app
from dmrl.images.codec import encode_png
from dmrl.learn.inference.decode_grids import decode
from dmrl.learn.pretrained import list_pretrained

pytestmark = pytest.mark.heavy
WARNINGS = ["-O1", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
COMPILERS = [pair for pair in (("gcc", "g++"), ("clang", "clang++")) if shutil.which(pair[0])]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a recording and exports of a shipped network: float, int8, and with two memories."""
    place = tmp_path_factory.mktemp("usage")
    for line in (
        ["sketch", "pictures", "--images", "40"],
        ["convert", "pictures", "pictures.mcap"],
        ["dataset", "pictures.mcap", "dataset"],
        ["quantize", "dmrl-nano", "dataset", "int8", "--images", "4"],
        ["export", "dmrl-nano", "float", "--decoded"],
        ["export", "int8", "network", "--decoded"],
        ["export", "int8", "two", "--l1-kb", "64"],
    ):
        names = [
            w if w.startswith("-") or w.isdigit() or w == "dmrl-nano" else str(place / w)
            for w in line[1:]
        ]
        app([line[0], *names], result_action="return_value")
    return place


def read_programs(folder: Path, kind: str) -> list[str]:
    """Return the example programs of one language in the README of an export."""
    text = (folder / "README.md").read_text(encoding="utf-8")
    text = text[text.index(": from an image to pixels") :]
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


def parse_numbers(said: str) -> list[float]:
    """Return the decimal numbers in the first line."""
    return [float(n) for n in re.findall(r"-?\d+\.\d+", said.splitlines()[0])]


def find_image(folders: Path) -> np.ndarray:
    """Return the first image in which the network finds a robot."""
    images = dmrl.open(folders / "pictures.mcap").images()
    detector = dmrl.load(folders / "network", backend="onnx-int8")
    return next(image for image in images if detector.detect(image[None])[0])


def detect_best(model: Path, backend: str, image: np.ndarray) -> list[float]:
    """Return u, v, depth and confidence of the first detection."""
    found = dmrl.load(model, backend=backend).detect(image[None])[0][0]
    return [found.u_px, found.v_px, found.depth_m, found.confidence]


@pytest.mark.parametrize("name", ["float", "network"])
def test_onnxruntime_program_finds_the_same_detections(folders: Path, name: str) -> None:
    folder, image = folders / name, find_image(folders)
    first, node = read_programs(folder, "python")
    (folder / "detect.py").write_text(first)
    (folder / "node.py").write_text(node)
    (folder / "image.png").write_bytes(encode_png(image))
    py_compile.compile(str(folder / "node.py"), doraise=True)
    line = [sys.executable, "detect.py", "image.png"]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=True)
    int8 = (folder / "model.int8.onnx").is_file()
    wanted = detect_best(folder, "onnx-int8" if int8 else "onnx", image)
    np.testing.assert_allclose(parse_numbers(done.stdout), wanted, atol=0.06)


@pytest.mark.parametrize("name", ["network", "two"])
@pytest.mark.parametrize(("cc", "cxx"), COMPILERS)
def test_the_programs_in_c_and_cpp_compile_cleanly_and_find_the_same(
    folders: Path, name: str, cc: str, cxx: str, tmp_path: Path
) -> None:
    folder, image = folders / name, find_image(folders)
    (in_c,), (in_cpp,) = read_programs(folder, "c"), read_programs(folder, "cpp")
    (tmp_path / "detect.c").write_text(in_c)
    (tmp_path / "detect.cpp").write_text(in_cpp)
    there = ["-I", str(folder)]
    code = str(folder / "dmrl_nano.c")
    for line in (
        [cc, "-std=c99", *WARNINGS, *there, "detect.c", code, "-o", "as_c"],
        [cc, "-std=c99", *WARNINGS, *there, "-c", code, "-o", "net.o"],
        [cxx, "-std=c++11", *WARNINGS, *there, "detect.cpp", "net.o", "-o", "as_cpp"],
    ):
        subprocess.run(line, cwd=tmp_path, check=True)
    wanted = detect_best(folder, "integer", image)
    for program in ("as_c", "as_cpp"):
        done = subprocess.run(
            [tmp_path / program], input=image.tobytes(), capture_output=True, check=True
        )
        np.testing.assert_allclose(parse_numbers(done.stdout.decode()), wanted, atol=0.07)


@pytest.mark.parametrize(
    ("maps", "decoded"), [("model.onnx", "decoded.onnx"), ("model.int8.onnx", "decoded.int8.onnx")]
)
def test_onnx_detections_equal_decoded_maps(folders: Path, maps: str, decoded: str) -> None:
    ort = pytest.importorskip("onnxruntime")
    images = dmrl.open(folders / "pictures.mcap").images().to_numpy()
    options = ort.SessionOptions()
    options.add_session_config_entry("session.x64quantprecision", "1")
    session = ort.InferenceSession(folders / "network" / maps, options)
    names = [output.name for output in session.get_outputs()]
    out = dict(zip(names, session.run(None, {"image": images}), strict=True))
    offset = np.stack([out["offset_u"], out["offset_v"]], axis=1)
    confidence = (1 / (1 + np.exp(-out["confidence_logit"].astype(float)))).astype(np.float32)
    wanted = decode(confidence, np.exp(out["log_depth"]), offset, min_confidence=0.02)
    (found,) = ort.InferenceSession(folders / "network" / decoded, options).run(
        None, {"image": images}
    )
    assert found.shape == (len(images), 20, 4)
    for k, rows in enumerate(found):
        kept = rows[rows[:, 3] >= 0.02]
        count = int((wanted.confidence[k, : wanted.count[k]] >= 0.02).sum())
        columns = ("u_px", "v_px", "depth_m", "confidence")
        held = np.stack([getattr(wanted, name)[k, :count] for name in columns], axis=1)
        np.testing.assert_allclose(kept, held, atol=1e-3)


@pytest.mark.parametrize("name", list_pretrained())
def test_shipped_network_exports_its_int8_network(name: str, tmp_path: Path) -> None:
    """Its outputs agree with the shipped weights; benchmarks/ship_int8.py makes it from them."""
    app(["export", name, str(tmp_path / "out")], result_action="return_value")
    assert (tmp_path / "out/model.int8.onnx").is_file() and list((tmp_path / "out").glob("*.c"))
    dmrl.sketch(tmp_path / "drawn", images=12, seed=5)
    images = dmrl.convert(tmp_path / "drawn", tmp_path / "drawn.mcap").images().to_numpy()
    float_grids = dmrl.load(name, backend="torch").grids(images)
    int8_grids = dmrl.load(name, backend="onnx-int8").grids(images)
    both = [grids.confidence.ravel() for grids in (float_grids, int8_grids)]
    assert np.corrcoef(*both)[0, 1] > 0.97
