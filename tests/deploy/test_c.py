"""Generated C code of networks, compared bit for bit with the integer reference."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl.deploy.bayer_input import demosaic
from dmrl.deploy.c import c_name, write_c
from dmrl.deploy.c.harness import parse_results
from dmrl.deploy.c.network_source import generate_source
from dmrl.deploy.c.run.compile_targets import RISCV_FLAGS, SANITIZER_FLAGS, Build, Target
from dmrl.deploy.c.run.compiled import CompiledNetwork
from dmrl.deploy.c.run.measure import measure_cost
from dmrl.deploy.c.run.toolchain import EMULATOR, RISCV, find_missing
from dmrl.deploy.c.run.verification import TargetResult, compute_expected, verify_target
from dmrl.deploy.c.templating import template_values
from dmrl.deploy.int8.layers import Conv
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import decode_detections, run_network
from dmrl.errors import ModelError, SettingError, ToolError

from .graphs import quantise_untrained, quantised_network
from .networks import random_network

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
QUICK = Target("gcc", (Build("-O0", "gcc", ("-O0",)),))
CHECKED = Target("sanitizers", (Build("-O1", "gcc", SANITIZER_FLAGS),))


SMALLEST = min(map(random_network, range(20)), key=lambda network: network.macs)
"""The network with the fewest operations of twenty."""


def find_quantisable(seed: int) -> IntegerNetwork:
    """Return ``quantised_network(seed)``, or that of seed + 1000 if a layer is always zero."""
    try:
        return quantised_network(seed)
    except SettingError:
        return find_quantisable(seed + 1000)


def draw_images(network: IntegerNetwork, count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Draw random images (N, H, W, C) of a network's input size."""
    shape = (count, network.height_px, network.width_px, network.channels)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def verify(network: IntegerNetwork, folder: Path, target: Target) -> TargetResult:
    """Write the C of a network and compare it with the reference on three noise images."""
    write_c(network, folder, [])
    return verify_target(
        network, folder, target, compute_expected(network, list(draw_images(network, 3)))
    )


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.heavy
def test_quantized_random_networks_match_the_c_bit_for_bit(seed: int, tmp_path: Path) -> None:
    result = verify(find_quantisable(seed), tmp_path, QUICK)
    assert (result.error, result.mismatches) == (None, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(200))
def test_two_hundred_random_networks_match_under_sanitizers(seed: int, tmp_path: Path) -> None:
    result = verify(find_quantisable(seed), tmp_path, CHECKED)
    assert (result.error, result.mismatches) == (None, 0)


@pytest.mark.heavy
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 9))]
)
def test_random_integer_networks_match_the_reference(seed: int, tmp_path: Path) -> None:
    result = verify(random_network(seed), tmp_path, CHECKED)
    assert (result.error, result.mismatches) == (None, 0)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("channels", "phase"), [(3, (0, 0)), (3, (0, 1)), (3, (1, 0)), (3, (1, 1)), (1, (0, 1))]
)
def test_c_demosaicing_matches_the_reference_in_any_bayer_phase(
    channels: int, phase: tuple[int, int], tmp_path: Path
) -> None:
    network = next(n for n in map(quantised_network, range(20)) if n.channels == channels)
    write_c(network, tmp_path, [])
    flags = tuple(f"-DRANDOM_RED_{axis}={k}" for axis, k in zip(("ROW", "COL"), phase, strict=True))
    build = Build("Bayer", "gcc", ("-O1", *flags), bayer=True)
    raw = draw_images(network, 1)[0, ..., 0]
    command = build.compile_program(network, tmp_path, tmp_path)
    said = subprocess.run(command, input=raw.tobytes(), check=True, capture_output=True)
    row, col = phase
    seen = demosaic(raw, channels=channels, red_row=row, red_col=col)
    (answer,) = parse_results(network, said.stdout)
    wanted = run_network(network, seen)
    assert all(np.array_equal(answer.grids[head], wanted[head]) for head in wanted)


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.heavy
def test_the_c_is_strict_c99_without_a_warning(compiler: str, tmp_path: Path) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler}")
    for k, network in enumerate((quantised_network(0), quantised_network(1), random_network(3))):
        folder = tmp_path / str(k)
        folder.mkdir()
        write_c(network, folder, [])
        for bayer in ("0", "1"):
            command = [compiler, *STRICT, f"-DRANDOM_BAYER={bayer}", "-fsyntax-only", "random.c"]
            subprocess.run(command, cwd=folder, check=True, capture_output=True)


@pytest.mark.parametrize("level", ["-O0", "-O2", "-O3", "-Os"])
@pytest.mark.heavy
def test_the_c_calls_no_library(level: str, tmp_path: Path) -> None:
    if shutil.which(RISCV) is None:
        pytest.skip(f"no {RISCV}")
    write_c(quantised_network(1), tmp_path, [])
    flags = ("-std=c99", level, *RISCV_FLAGS)
    subprocess.run([RISCV, *flags, "-c", "random.c", "-o", "random.o"], cwd=tmp_path, check=True)
    tool = RISCV.replace("gcc", "nm")
    said = subprocess.run([tool, "-u", "random.o"], cwd=tmp_path, check=True, capture_output=True)
    assert said.stdout == b""


@pytest.mark.heavy
def test_the_self_test_passes_and_fails_when_a_weight_is_changed(tmp_path: Path) -> None:
    network = quantised_network(2)
    write_c(network, tmp_path, list(draw_images(network, 1, seed=5)))
    done = subprocess.run(["make", "test"], cwd=tmp_path, check=True, capture_output=True)
    assert done.stdout.count(b"as the reference") == 2
    (tmp_path / "other").mkdir()
    write_c(_change_weight(network), tmp_path / "other", [])
    shutil.copy(tmp_path / "other" / "random.c", tmp_path)
    failed = subprocess.run(["make", "test"], cwd=tmp_path, capture_output=True, check=False)
    assert failed.returncode != 0
    assert b"DIFFERS" in failed.stdout


@pytest.mark.heavy
def test_the_self_test_needs_no_library_when_silent(tmp_path: Path) -> None:
    if shutil.which(RISCV) is None:
        pytest.skip(f"no {RISCV}")
    write_c(quantised_network(2), tmp_path, [])
    flags = ("-std=c99", "-O2", *RISCV_FLAGS, "-DSILENT", "-Wl,--entry=main")
    command = [RISCV, *flags, "main.c", "random.c", "-o", "self_test"]
    subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.heavy
def test_a_self_test_for_raw_mosaics_passes_as_well(tmp_path: Path) -> None:
    network = next(n for n in map(quantised_network, range(20)) if n.channels == 3)
    write_c(network, tmp_path, list(draw_images(network, 1)), bayer=True)
    done = subprocess.run(["make", "test"], cwd=tmp_path, check=True, capture_output=True)
    assert done.stdout.count(b"as the reference") == 2


def _change_weight(network: IntegerNetwork) -> IntegerNetwork:
    """Return the network with one changed weight in its last convolution."""
    last = network.layers[-1]
    assert isinstance(last, Conv)
    weight = last.weight.copy()
    weight[0, 0, 0, 0] += 1 if weight[0, 0, 0, 0] < 100 else -1
    return replace(network, layers=(*network.layers[:-1], replace(last, weight=weight)))


@pytest.mark.heavy
def test_layers_may_have_any_names(tmp_path: Path) -> None:
    network = max(map(random_network, range(20)), key=lambda n: len(n.layers))
    names = ("conv", "conv_weights", "while", "random_run", "3", "Conv", "passing_0", "")
    layers = tuple(
        replace(layer, name=names[k % len(names)]) for k, layer in enumerate(network.layers)
    )
    result = verify(replace(network, layers=layers), tmp_path, QUICK)
    assert (result.error, result.mismatches) == (None, 0)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("architecture", "name"),
    [
        ("locanet", "locanet"),
        ("dmrl-nano", "dmrl_nano"),
        ("3-Tiny Nets!", "net_3_tiny_nets"),
        ("main", "net_main"),
        ("string", "string"),
        ("__x #error", "x_error"),
        ("網", "net"),
        ("x" * 300, "x" * 40),
    ],
)
def test_files_and_functions_are_named_after_the_architecture(
    architecture: str, name: str, tmp_path: Path
) -> None:
    network = replace(SMALLEST, architecture=architecture, name="some folder")
    assert c_name(network) == name
    result = verify(network, tmp_path, QUICK)
    assert (result.error, result.mismatches) == (None, 0)
    assert {f"{name}.c", f"{name}.h", f"{name}_vectors.h"} <= {f.name for f in tmp_path.iterdir()}
    assert f"int {name}_run(" in (tmp_path / f"{name}.h").read_text()
    made = ["make", "self_test", "CFLAGS=-O0"]
    subprocess.run(made, cwd=tmp_path, check=True, capture_output=True)


@pytest.mark.heavy
def test_two_networks_go_into_one_program(tmp_path: Path) -> None:
    one, other = (replace(random_network(k), architecture=f"net-{k}") for k in (0, 1))
    for network in (one, other):
        write_c(network, tmp_path, [])
    (tmp_path / "both.c").write_text(
        '#include "net_0.h"\n#include "net_1.h"\n'
        "static net_0_t a;\nstatic net_1_t b;\n"
        "int main(void) { net_0_init(&a); net_1_init(&b); return 0; }\n"
    )
    command = ["gcc", "-std=c99", "-O0", "both.c", "net_0.c", "net_1.c", "-o", "both"]
    subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.heavy
def test_the_same_network_gives_the_same_text() -> None:
    network = quantised_network(4)
    one, two = (generate_source(network, template_values(network), bayer=False) for _ in range(2))
    assert one == two


@pytest.mark.heavy
def test_first_peaks_are_kept_if_there_are_too_many() -> None:
    network = replace(quantised_network(1), threshold=0.0)
    compiled = CompiledNetwork(network)
    image = draw_images(network, 1)[0]
    grids = run_network(network, image)
    for most in (0, 1, 2, 5):
        assert compiled.run_detections(image, most).detections == decode_detections(
            network, grids, most
        )


def test_a_layer_that_the_c_cannot_carry_is_named() -> None:
    network = next(n for n in map(quantised_network, range(20)) if _find_depthwise(n) is not None)
    at = _find_depthwise(network)
    assert at is not None
    layers = list(network.layers)
    conv = layers[at]
    assert isinstance(conv, Conv)
    layers[at] = replace(conv, name="odd", weight=conv.weight[:, :, :1, :1], padding=0)
    odd = replace(network, layers=tuple(layers))
    with pytest.raises(ModelError, match="layer odd is a depthwise 1x1"):
        generate_source(odd, template_values(odd), bayer=False)


def _find_depthwise(network: IntegerNetwork) -> int | None:
    """Return the index of the first depthwise layer."""
    return next(
        (
            k
            for k, layer in enumerate(network.layers)
            if isinstance(layer, Conv) and layer.depthwise
        ),
        None,
    )


def test_without_a_compiler_the_package_to_install_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ToolError, match="apt-get install gcc"):
        CompiledNetwork(quantised_network(0))


@pytest.mark.parametrize(
    ("name", "bytes_"),
    [
        ("locanet", 25_000),
        ("dmrl-nano", 103_200),
        ("dmrl-nano-fine", 132_000),
    ],
)
@pytest.mark.heavy
def test_the_state_fits_a_small_chip(name: str, bytes_: int) -> None:
    integers = quantise_untrained(name)
    made = generate_source(integers, template_values(integers), bayer=False)
    assert made.values["state_bytes"] + made.values["bayer_bytes"] <= bytes_


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["locanet", "dmrl-nano"])
def test_shipped_architectures_match_the_c_bit_for_bit(name: str, tmp_path: Path) -> None:
    result = verify(quantise_untrained(name, 176, 96), tmp_path, QUICK)
    assert (result.error, result.mismatches) == (None, 0)


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "most"), [("locanet", 2.7), ("dmrl-nano", 2.78)])
def test_instructions_per_mac_on_riscv_are_limited(name: str, most: float, tmp_path: Path) -> None:
    if find_missing(RISCV, EMULATOR):
        pytest.skip("no RISC-V tools")
    integers = quantise_untrained(name)
    write_c(integers, tmp_path, [])
    found = measure_cost(integers, tmp_path, draw_images(integers, 1)[0])
    assert found.instructions is not None
    assert found.instructions / integers.macs < most
