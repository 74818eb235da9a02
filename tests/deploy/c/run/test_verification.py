"""Verification of exported C: grids and detections of all builds must match within the stack."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.c.harness import HarnessResult
from dmrl.deploy.c.network_source import MAX_STACK_BYTES
from dmrl.deploy.c.run import measure, verification
from dmrl.deploy.c.run.compile_targets import Build, Target
from dmrl.deploy.c.run.measure import (
    CLUSTER_HZ,
    KERNEL_MACS_PER_CYCLE,
    ExecutionCost,
    StateMemory,
    estimate_rates,
    parse_state_memory,
)
from dmrl.deploy.c.run.verification import (
    BuildResult,
    TargetResult,
    compute_expected,
    is_same_result,
    verify_target,
)
from dmrl.deploy.int8.reference import IntegerDetection
from dmrl.errors import ModelError

from ...networks import random_network

FOUND = [IntegerDetection(16, 32, 1500, 40_000)]
ANSWER = HarnessResult(
    {"confidence": np.eye(3, dtype=np.int8), "depth": np.eye(3, dtype=np.int8)}, FOUND, 0
)


def test_results_are_equal_if_all_grids_and_detections_are() -> None:
    assert is_same_result(ANSWER, replace(ANSWER, stack_bytes=9))
    for name in ("confidence", "depth"):
        assert not is_same_result(
            ANSWER, replace(ANSWER, grids=ANSWER.grids | {name: 2 * np.eye(3)})
        )
    assert not is_same_result(ANSWER, replace(ANSWER, detections=[]))
    assert not is_same_result(
        ANSWER, replace(ANSWER, detections=[replace(FOUND[0], depth_mm=1501)])
    )


def test_mismatches_are_summed_over_builds() -> None:
    right, wrong = BuildResult("-O1", 3, 0, 0), BuildResult("-O2", 3, 2, 0)
    assert TargetResult("gcc", [right]).mismatches == 0
    assert TargetResult("gcc", [wrong, right, wrong]).mismatches == 4


@pytest.mark.parametrize(
    ("stack", "drop", "words"),
    [
        (MAX_STACK_BYTES, 0, ""),
        (MAX_STACK_BYTES + 1, 0, f"uses {MAX_STACK_BYTES + 1} bytes of stack"),
        (0, 1, "answered 1 of 2 images"),
    ],
)
def test_build_must_answer_every_image_within_its_stack(
    stack: int, drop: int, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    network = random_network(1)
    images = list(
        np.random.default_rng(0).integers(
            0, 256, (2, network.height_px, network.width_px, network.channels), np.uint8
        )
    )
    wanted = compute_expected(network, images)
    given = {
        False: [replace(a, stack_bytes=stack) for a in (a for _, a in wanted[False])],
        True: [a for _, a in wanted[True]],
    }
    given[True][1] = replace(given[True][1], detections=FOUND)
    monkeypatch.setattr(Build, "compile_program", lambda build, *_: [build])
    monkeypatch.setattr(verification, "run_program", lambda command, *_, **__: command[0].bayer)
    kept = slice(drop, None)
    monkeypatch.setattr(verification, "parse_results", lambda _, bayer: given[bayer][kept])
    builds = Build("-O1", "cc", ()), Build("Bayer", "cc", (), bayer=True)
    monkeypatch.setattr(Target, "skipped", "")
    result = verify_target(network, tmp_path, Target("cc", builds), wanted)
    assert words in (result.error or "")
    assert bool(result.error) == bool(words)
    if not words:
        assert [(b.images, b.mismatches) for b in result.builds] == [(2, 0), (2, 1)]
        assert result.builds[0].stack_bytes == stack


def test_rates_are_images_per_second() -> None:
    network = random_network(1)
    both = estimate_rates(network, ExecutionCost(1, 2, round(CLUSTER_HZ / 25)), StateMemory(49_152))
    assert [rate for rate, _ in both] == pytest.approx(
        [25, CLUSTER_HZ * KERNEL_MACS_PER_CYCLE / network.macs]
    )
    assert (
        len(estimate_rates(network, ExecutionCost(1, 2, None), StateMemory(1)))
        == len(estimate_rates(network, ExecutionCost(), StateMemory(1)))
        == 1
    )
    assert not any("L1" in assumed for _, assumed in both)
    over = estimate_rates(network, ExecutionCost(1, 2, 3), StateMemory(102_138))
    assert all(
        "L2, where 102,138 bytes of state lie that do not fit L1" in said for _, said in over
    )


def test_the_header_states_the_bytes_of_the_state(tmp_path: Path) -> None:
    header = tmp_path / "random.h"
    header.write_text("#define RANDOM_STATE_BYTES (1234 + 8)\n")
    assert parse_state_memory(random_network(1), tmp_path) == StateMemory(1234)
    header.write_text("nothing")
    with pytest.raises(ModelError, match=r"random\.h is damaged"):
        parse_state_memory(random_network(1), tmp_path)


def test_instructions_per_image_are_the_increment_of_a_second_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image, flags = np.zeros((4, 5, 3), np.uint8), []
    counted = {"words": "executed {} instructions"}

    def run_both(_command: object, _what: str, *, data: bytes) -> tuple[bytes, str]:
        return b"", counted["words"].format(1000 + 7 * len(data))

    monkeypatch.setattr(Build, "compile_program", lambda *_: ["qemu", "program"])
    monkeypatch.setattr(measure, "find_host_compiler", lambda: "cc")
    monkeypatch.setattr(measure, "run_program", lambda command, _: flags.append(command))
    monkeypatch.setattr(measure, "run_with_stderr", run_both)
    for version, plugin in ((8, 1), (9, 2)):
        monkeypatch.setattr(measure, "get_emulator_version", lambda version=version: version)
        assert measure._count_instructions(random_network(1), tmp_path, tmp_path, image) == 7 * 60
        assert f"-DPLUGIN_VERSION={plugin}" in flags[-1]
    counted["words"] = "no plugins here"
    assert measure._count_instructions(random_network(1), tmp_path, tmp_path, image) is None
