"""The pilot's C gives the commands of its reference bit for bit, in a flight and at random."""

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.c.pilot_code import PILOT_BYTES, write_pilot
from dmrl.deploy.c.run.compiled import CompiledNetwork
from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise_model import quantise_model
from dmrl.flight.onboard_input import DETECTIONS_MAX, RawDetection, RobotState, to_raw
from dmrl.flight.onboard_pilot import CONSTANTS, OnboardFilter
from dmrl.formats.aideck.cpx import Image, ImageReader
from dmrl.formats.aideck.cpx_detections import pack_detections, parse_detections
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.geometry.frames import AIDECK_PINHOLE
from dmrl.images.codec import decode, encode_jpeg
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.pretrained import resolve_model_path
from dmrl.simulation import Simulation
from dmrl.simulation.drawn_pictures import draw_picture
from dmrl.simulation.settings import SketchSettings

from .compiled_pilot import CompiledPilot

DISTANCE_M = 0.7


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the C code of the pilot."""
    write_pilot(tmp_path, AIDECK_PINHOLE, CONSTANTS, DETECTIONS_MAX)
    return tmp_path


def skip_without(*programs: str) -> pytest.MarkDecorator:
    """Return a mark that skips where a program is missing."""
    absent = [name for name in programs if shutil.which(name) is None]
    return pytest.mark.skipif(bool(absent), reason=f"no {absent}")


class Pictures:
    """Sixteen sketched images for the calibration."""

    def __len__(self) -> int:
        return 16

    def images(self, rows: Sequence[int]) -> Iterator[np.ndarray]:
        return (draw_picture(SketchSettings(), k).rgb for k in rows)


def quantise_nano() -> IntegerNetwork:
    """Return dmrl-nano quantised on sketched pictures."""
    model = load_model(resolve_model_path(Path("dmrl-nano")))
    return quantise_model(model, Pictures(), 16, grey=False).network


def draw_steps(seed: int) -> list[tuple[RobotState, float, list[RawDetection]]]:
    """Draw 400 steps: state, image time and detections, with gaps, late images and jumps."""
    rng, image_s, steps = np.random.default_rng(seed), -1.0, []
    for k in range(400):
        values = rng.normal(0, [0.1, 0.1, 0.6, 0.5, 0.5], 5).tolist()
        state = RobotState(0.05 * k, *values, 1.0 + float(rng.normal(0, 0.02)))
        if k % 2 and rng.random() < 0.8 and not 100 < k < 180:
            image_s = max(round(state.time_s - float(rng.choice([0.1, 0.15, 0.7])), 3), 0.0)
        high = (5120, 3584, 2500, 65536)
        rows = rng.integers((0, 0, 200, 300), high, (int(rng.integers(0, 6)), 4)).tolist()
        steps.append((state, image_s, [RawDetection(*row) for row in rows]))
    return steps


@pytest.mark.parametrize("emulated", [False, pytest.param(True, marks=pytest.mark.heavy)])
@pytest.mark.heavy
def test_c_pilot_commands_equal_the_reference(folder: Path, emulated: bool) -> None:
    if emulated and not (shutil.which("qemu-riscv32") and shutil.which("riscv64-unknown-elf-gcc")):
        pytest.skip("no emulator")
    commands = []
    with CompiledPilot(folder, DISTANCE_M, emulated=emulated) as compiled:
        pilot, before_s = OnboardFilter(DISTANCE_M), -1.0
        for state, image_s, found in draw_steps(1):
            fresh = image_s != before_s
            packet = pack_detections(0, round(1000 * image_s), found) if fresh else b""
            before_s = image_s
            expected = pilot.step(state, image_s, found)
            assert compiled.step(state, packet) == expected
            commands.append(expected)
    assert np.ptp(np.array(commands), axis=0).min() > 0.05  # the commands vary


def test_pilot_ignores_repeated_and_late_images() -> None:
    found = [RawDetection(2560, 1200, 700, 60000)]
    hover = RobotState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    again, without = OnboardFilter(DISTANCE_M), OnboardFilter(DISTANCE_M)
    for k in range(1, 60):
        state = hover._replace(time_s=0.05 * k)
        # A repeated image and one that is too old change nothing.
        late_s = 0.05 if k < 20 else 0.06
        assert again.step(state, late_s, found) == without.step(state, 0.05, found if k < 2 else [])
    assert again.step(state._replace(time_s=3.1), 0.06, found)[:3] == (0.0, 0.0, 0.0)


def test_packets_are_read_as_they_were_written() -> None:
    rows = [RawDetection(-5, 3584, 65535, 0), RawDetection(5120, 0, 1, 65535)]
    packet = pack_detections(70_000, 12_345, rows)
    assert parse_detections(packet) == (70_000 % 65536, 12_345, [tuple(row) for row in rows])
    assert parse_detections(packet[:-1]) is None and parse_detections(b"") is None
    assert parse_detections(pack_image(Image(2, 1, "raw", b"ab"))) is None


@skip_without("clang")
@pytest.mark.heavy
def test_pilot_compiles_for_a_cortex_m4_without_a_library_at_its_stated_size(
    folder: Path,
) -> None:
    size = f'#include "pilot.h"\nchar fits[sizeof(pilot_t) == {PILOT_BYTES} ? 1 : -1];\n'
    (folder / "size.c").write_text(size)
    for name in ("size.c", "pilot.c"):
        line = ["clang", "--target=thumbv7em-none-eabi", "-mcpu=cortex-m4", "-ffreestanding"]
        line += ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
        subprocess.run([*line, "-c", folder / name, "-o", folder / "m4.o"], check=True)
    said = subprocess.run(["nm", folder / "m4.o"], capture_output=True, text=True, check=True)
    # It calls only arithmetic and copy helpers of the compiler, and has no static memory.
    used = [line.split()[-1] for line in said.stdout.splitlines() if " U " in line]
    assert all(name.startswith("__aeabi") for name in used)
    assert " b " not in said.stdout and " d " not in said.stdout


@pytest.mark.heavy
def test_camera_network_packets_and_pilot_fly_together(folder: Path) -> None:
    """In a flight of 30 s the C network and pilot, joined by packets, equal the reference."""
    network = quantise_nano()
    chip, flown = CompiledNetwork(network), []
    with (
        Simulation(robots=2, flown=1, camera_renderer="sketch") as simulation,
        CompiledPilot(folder, DISTANCE_M) as compiled,
    ):
        seen = simulation.reset(seed=5)["cf1"]
        pilot, link, waiting, number = OnboardFilter(DISTANCE_M), ImageReader(), [], 0
        image_s, rows = -1.0, []
        while not simulation.is_over:
            step = round(seen.time_s / 0.05)
            packet = b""
            if step % 2 == 1:
                jpeg = encode_jpeg(simulation.render("cf1").rgb, 92)
                (image,) = link.feed(pack_image(Image(320, 224, "jpeg", jpeg)))
                result = chip.run_detections(decode(image.data), DETECTIONS_MAX)
                if number % 60 == 0:
                    grids = reference.run_network(network, decode(image.data))
                    for head, grid in grids.items():
                        np.testing.assert_array_equal(grid, result.grids[head])
                waiting.append(
                    pack_detections(number, 50 * step, [astuple(one) for one in result.detections])
                )
                number += 1
            if step % 2 == 1 and len(waiting) > 1:
                packet = waiting.pop(0)
                _, time_ms, rows = parse_detections(packet)
                image_s, rows = time_ms / 1000, [RawDetection(*row) for row in rows]
            state, _, _ = to_raw(replace(seen, detections=()))
            command = compiled.step(state, packet)
            assert command == pilot.step(state, image_s, rows)
            flown.append(command)
            seen = simulation.step({"cf1": command})["cf1"]
    assert len(flown) == 600 and number == 300
    assert np.abs(np.array(flown)).max(axis=0).min() > 0.05
