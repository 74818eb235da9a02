"""Detectors that are opened with each backend give equal results."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dmrl.deploy.backends import build_reference_backend, to_grids, to_network_input
from dmrl.deploy.c.run.toolchain import EMULATOR, RISCV, find_missing
from dmrl.deploy.detector import Detector, open_detector
from dmrl.deploy.int8.graph import rgb_to_grey
from dmrl.deploy.int8.store import INTEGER_NAME, save_network
from dmrl.deploy.onnx import float_cache
from dmrl.deploy.onnx.float_model import float_onnx_of
from dmrl.errors import ModelError, SettingError, ToolError
from dmrl.learn.inference.loaded_model import Model, load_model, save_model
from dmrl.learn.networks.architectures import build_network

from .graphs import quantised_network

needs_riscv = pytest.mark.skipif(bool(find_missing(RISCV, EMULATOR)), reason="no RISC-V tools")


@pytest.mark.heavy
@pytest.mark.parametrize(
    "backend", ["integer", "onnx-int8", "c", pytest.param("riscv32", marks=needs_riscv)]
)
def test_int8_backends_give_equal_outputs(backend: str, tmp_path: Path) -> None:
    network = replace(quantised_network(11), threshold=0.37)
    save_network(network, tmp_path / INTEGER_NAME)
    shape = (2, network.height_px, network.width_px, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    detector = open_detector(tmp_path, backend)  # type: ignore[arg-type]
    assert (detector.name, detector.stride_px) == (tmp_path.name, network.stride_px)
    assert detector.threshold == pytest.approx(0.37)
    assert detector.size_px == (network.width_px, network.height_px)
    assert detector.file == tmp_path / INTEGER_NAME
    wanted = to_grids(build_reference_backend(network).outputs(images))
    got = detector.grids(images)
    np.testing.assert_allclose(got.confidence, wanted.confidence, atol=1e-6)
    np.testing.assert_allclose(
        np.log(got.depth_m + 1e-30), np.log(wanted.depth_m + 1e-30), atol=1e-4
    )


def write_run_folder(folder: Path) -> Path:
    """Write the run folder of a network with random weights for 64 x 48 px."""
    folder.mkdir()
    network = build_network("locanet", seed=3).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.03 * torch.randn(parameter.shape, generator=torch.manual_seed(1))
    save_model(Model(network, "locanet", threshold=0.41, width_px=64, height_px=48), folder)
    return folder


@pytest.mark.heavy
def test_float_backends_and_export_give_equal_outputs(tmp_path: Path) -> None:
    run = write_run_folder(tmp_path / "run")
    images = np.random.default_rng(0).integers(0, 256, (2, 48, 64, 3), np.uint8)
    export = tmp_path / "export"
    export.mkdir()
    (export / "model.onnx").write_bytes(float_onnx_of(load_model(run), grey=False))
    (export / "model.json").write_text(json.dumps({"stride_px": 8, "threshold": 0.41}))
    found = {
        name: open_detector(where, backend)  # type: ignore[arg-type]
        for name, where, backend in (
            ("torch", run, "torch"),
            ("onnx", run, "onnx"),
            ("export", export, "onnx"),
        )
    }
    wanted = found["torch"].grids(images)
    for detector in found.values():
        assert (detector.stride_px, detector.threshold) == (8, pytest.approx(0.41))
        got = detector.grids(images)
        np.testing.assert_allclose(got.confidence, wanted.confidence, atol=1e-5)
        np.testing.assert_allclose(got.depth_m, wanted.depth_m, rtol=1e-4)
    assert [d.size_px for d in found.values()] == [None, (64, 48), (64, 48)]
    weights, onnx = run / "model.safetensors", export / "model.onnx"
    assert [d.file for d in found.values()] == [weights, weights, onnx]
    with pytest.raises(ModelError, match=r"is an export folder, which torch cannot run"):
        open_detector(export, "torch")
    for backend in ("integer", "onnx-int8", "c", "riscv32"):
        with pytest.raises(ModelError, match=f"as --backend {backend} needs"):
            open_detector(run, backend)  # type: ignore[arg-type]
        with pytest.raises(ModelError, match=f"--backend {backend} is int8"):
            open_detector(weights, backend)  # type: ignore[arg-type]
    for text in ('{"stride_px": 0, "threshold": 0.4}', '{"stride_px": 8}', "{"):
        (export / "model.json").write_text(text)
        with pytest.raises(ModelError, match=r"model\.json is damaged"):
            open_detector(export, "onnx")
    with pytest.raises(ModelError, match="no model"):
        open_detector(tmp_path / "none", "torch")


@pytest.mark.parametrize(
    ("size_px", "image_px", "fits"),
    [
        (None, (64, 48), True),
        (None, (68, 48), False),
        (None, (64, 44), False),
        ((64, 48), (64, 48), True),
        ((64, 48), (48, 64), False),
        ((64, 48), (72, 48), False),
    ],
)
def test_images_must_have_the_network_s_size_or_whole_cells(
    size_px: tuple[int, int] | None, image_px: tuple[int, int], fits: bool
) -> None:
    detector = Detector("m", lambda images: images, 8, 0.5, size_px, None)  # type: ignore[arg-type,return-value]
    if fits:
        detector.require_size(*image_px, "a.mcap")
        return
    with pytest.raises(SettingError, match=r"a\.mcap: images of {} x {} px".format(*image_px)) as e:
        detector.require_size(*image_px, "a.mcap")
    width_px, height_px = size_px or (image_px[0] // 8 * 8, image_px[1] // 8 * 8)
    assert f"dmrl convert ... --width-px {width_px} --height-px {height_px}" in str(e.value)


def test_grey_networks_get_grey_input() -> None:
    image = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)
    networks = [quantised_network(seed) for seed in range(4)]
    assert {network.channels for network in networks} == {1, 3}
    for network in networks:
        wanted = rgb_to_grey(image[None])[0] if network.channels == 1 else image
        assert (to_network_input(network, image) == wanted).all()


def test_extreme_logits_do_not_overflow() -> None:
    far = np.array([[[-1e9, 0.0, 1e9]]])
    grids = to_grids({"confidence": far, "log_depth": far, "offset_u": far, "offset_v": 2 * far})
    assert grids.confidence[0, 0].tolist() == pytest.approx([0, 0.5, 1])
    assert grids.depth_m[0, 0, :2].tolist() == [0, 1]
    assert np.isfinite(grids.depth_m).all()
    assert grids.offset is not None
    assert (grids.offset[:, 0] == far).all()
    assert (grids.offset[:, 1] == 2 * far).all()
    assert to_grids({"confidence": far, "log_depth": far, "offset_u": far}).offset is None


def test_missing_risc_v_tools_error_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_network(quantised_network(0), tmp_path / INTEGER_NAME)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ToolError, match="apt-get install gcc-riscv64-unknown-elf"):
        open_detector(tmp_path, "riscv32")


def test_the_cache_keeps_the_newest_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(float_cache, "KEPT", 2)
    folder = tmp_path / "cache" / "dmrl" / "onnx"
    folder.mkdir(parents=True)
    for age_s, name in enumerate(("newer", "older", "oldest"), 1):
        for suffix in (".onnx", ".json"):
            (folder / name).with_suffix(suffix).touch()
        os.utime(folder / f"{name}.onnx", (1e9 - age_s, 1e9 - age_s))
    made, _ = float_cache.build_float_onnx_once(write_run_folder(tmp_path / "run"), grey=False)
    kept = {path.stem for path in folder.glob("*.onnx")}
    assert len(kept) == 2 and "newer" in kept
    assert {path.stem for path in folder.glob("*.json")} == kept
    assert float_cache.build_float_onnx_once(tmp_path / "run", grey=False)[0] == made
    monkeypatch.chdir(tmp_path / "run")
    assert float_cache.build_float_onnx_once(Path(), grey=False)[0] == made
