"""C for two memories: buffers are placed, and layers use near memory only."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.c import MAX_L1_STATE_BYTES, write_c
from dmrl.deploy.c.buffer_plan import BufferPlan, plan_buffers
from dmrl.deploy.c.placement import Placement, place_buffers
from dmrl.deploy.c.run.compile_targets import SANITIZER_FLAGS, Build, Target
from dmrl.deploy.c.run.measure import StateMemory, parse_state_memory
from dmrl.deploy.c.run.verification import TargetResult, compute_expected, verify_target
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.errors import SettingError

from .graphs import quantise_untrained, quantised_network
from .networks import random_network

pytestmark = pytest.mark.heavy

GUARDED = Target("sanitizers", (Build("-O1", "gcc", SANITIZER_FLAGS),))
no_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")


def find_least_near_bytes(network: IntegerNetwork) -> int:
    """Return the least sufficient near memory from the error; 0 if everything must be near."""
    whole = plan_buffers(network)
    with pytest.raises(SettingError, match="at least") as error:
        place_buffers(whole, 0)
    least = int(re.findall(r"at least (\S+) bytes", str(error.value))[0].replace(",", ""))
    return least if least < Placement(whole).near_bytes(bayer=True) else 0


def find_splittable(seed: int) -> IntegerNetwork:
    """Return a random network that can use far memory, of every hundredth seed from this one."""
    make = random_network if seed % 2 else quantised_network
    return next(n for k in range(seed, 10_000, 100) if find_least_near_bytes(n := make(k)))


def verify(network: IntegerNetwork, folder: Path, near_bytes: int) -> TargetResult:
    """Generate C with two memories, and compare it with the reference on a target."""
    write_c(network, folder, [], near_bytes=near_bytes)
    return verify_target(network, folder, GUARDED, compute_expected(network, draw_images(network)))


def draw_images(network: IntegerNetwork) -> list[np.ndarray]:
    """Draw three random images of a network's input size."""
    shape = (3, network.height_px, network.width_px, network.channels)
    return list(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))


@no_gcc
@pytest.mark.parametrize("seed", [*range(4), 5, 12, 15, 19, 47])  # they cover all ways to read rows
def test_layers_use_near_memory_only_and_copy_the_stated_bytes(seed: int, tmp_path: Path) -> None:
    network = find_splittable(seed)
    result = verify(network, tmp_path, find_least_near_bytes(network))
    assert (result.error, result.mismatches) == (None, 0)
    assert parse_state_memory(network, tmp_path).far_bytes > 0


@no_gcc
@pytest.mark.parametrize("name", ["dmrl-nano", "dmrl-nano-fine"])
def test_shipped_networks_match_with_two_memories(name: str, tmp_path: Path) -> None:
    network = quantise_untrained(name, 176, 96)
    result = verify(network, tmp_path, find_least_near_bytes(network))
    assert (result.error, result.mismatches) == (None, 0)


@no_gcc
def test_layer_that_uses_far_memory_is_detected(tmp_path: Path) -> None:
    network = find_splittable(3)
    write_c(network, tmp_path, [], near_bytes=find_least_near_bytes(network))
    code = tmp_path / "random.c"
    text = code.read_text()
    assert "    return to;" in text
    code.write_text(text.replace("    return to;", "    return from;"))
    result = verify_target(
        network, tmp_path, GUARDED, compute_expected(network, draw_images(network))
    )
    assert result.error


@no_gcc
def test_too_little_copied_traffic_is_detected(tmp_path: Path) -> None:
    network = find_splittable(3)
    write_c(network, tmp_path, [], near_bytes=find_least_near_bytes(network))
    header = tmp_path / "random.h"
    stated = parse_state_memory(network, tmp_path).traffic_bytes
    header.write_text(header.read_text().replace(f"({stated})", f"({stated + 1})"))
    assert verify_target(
        network, tmp_path, GUARDED, compute_expected(network, draw_images(network))
    ).error


@no_gcc
def test_the_c_with_two_memories_is_strict_c99_without_a_warning(tmp_path: Path) -> None:
    flags = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
    for seed in range(4):
        network = find_splittable(seed)
        write_c(network, tmp_path, [], near_bytes=find_least_near_bytes(network))
        for more in ("-DRANDOM_BAYER=0", "-DRANDOM_BAYER=1", "-DRANDOM_COPY=dma"):
            command = ["gcc", *flags, more, "-fsyntax-only", "random.c"]
            subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)


@no_gcc
def test_the_self_test_passes_with_two_memories(tmp_path: Path) -> None:
    network = find_splittable(0)
    write_c(network, tmp_path, draw_images(network)[:1], near_bytes=find_least_near_bytes(network))
    done = subprocess.run(["make", "test"], cwd=tmp_path, check=True, capture_output=True)
    assert done.stdout.count(b"as the reference") == 2
    assert "run(&net, &away, image" in (tmp_path / "README.md").read_text()


def test_shipped_networks_fit_gap8_with_long_ring_buffers_in_far_memory() -> None:
    nano, fine = (
        plan_buffers(quantise_untrained("dmrl-nano")),
        plan_buffers(quantise_untrained("dmrl-nano-fine")),
    )
    for whole, far in ((nano, {"body_5_0"}), (fine, {"body_1_0", "body_9_0"})):
        two = place_buffers(whole, MAX_L1_STATE_BYTES)
        assert two.far == far
        assert two.near_bytes(bayer=True) <= MAX_L1_STATE_BYTES
    rows = place_buffers(nano, MAX_L1_STATE_BYTES).traffic_bytes - count_table_bytes(nano)
    # Rows have 40 x 48 bytes. Five depthwise layers read three rows each, five shortcuts read
    # one, and five layers write one.
    assert rows == 28 * 40 * 48 * (5 * 3 + 5 + 5)


def count_table_bytes(whole: BufferPlan) -> int:
    """Return the bytes of weights, biases, multipliers and gains copied for all rows."""
    total = 0
    for step, out in zip(whole.steps, whole.buffers[1:], strict=True):
        layer = step.layer
        total += out.rows * (layer.weight.size + 8 * layer.bias.size + 4 * layer.gain.size)
    return total


def test_placement_with_least_traffic_is_chosen() -> None:
    network = find_splittable(5)
    whole = plan_buffers(network)
    least, most = find_least_near_bytes(network), Placement(whole).near_bytes(bayer=True)
    assert not place_buffers(whole, most).far
    sizes = range(least, most, 64)
    ways = [place_buffers(whole, size) for size in sizes]
    copied = [way.traffic_bytes for way in ways]
    assert all(w.near_bytes(bayer=True) <= size for w, size in zip(ways, sizes, strict=True))
    assert copied == sorted(copied, reverse=True)
    with pytest.raises(SettingError, match=rf"at least {least:,} bytes .* {least - 4:,} are there"):
        place_buffers(whole, least - 4)


def test_the_header_states_both_sizes(tmp_path: Path) -> None:
    network = find_splittable(1)
    write_c(network, tmp_path, [], near_bytes=find_least_near_bytes(network))
    two = place_buffers(plan_buffers(network), find_least_near_bytes(network))
    wanted = StateMemory(two.near_bytes(bayer=False), two.far_bytes, two.traffic_bytes)
    assert parse_state_memory(network, tmp_path) == wanted
