"""`dmrl verify` compares generated C code with the reference."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.cli import app
from dmrl.deploy.c import write_c
from dmrl.deploy.c.network_source import MAX_STACK_BYTES
from dmrl.deploy.c.run import compile_targets, measure
from dmrl.deploy.c.run.measure import ExecutionCost
from dmrl.deploy.int8.layers import Conv
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.store import INTEGER_NAME, save_network
from dmrl.deploy.samples import save_samples
from dmrl.errors import DatasetError, ModelError, SettingError, ToolError
from dmrl.stages.verify import Settings, run

from ..deploy.networks import random_network

TOOLS = ("gcc", "clang", "riscv64-unknown-elf-gcc", "qemu-riscv32")
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
SEED = 3
GCC = Settings(targets=("gcc",), images=2, noise=1)


def write_export(
    network: IntegerNetwork, folder: Path, carries: IntegerNetwork | None = None
) -> Path:
    """Write an export folder; its C code may be that of another network, ``carries``."""
    folder.mkdir()
    write_c(carries or network, folder, [])
    save_network(network, folder / INTEGER_NAME)
    shape = (3, network.height_px, network.width_px, 3)
    save_samples(np.random.default_rng(1).integers(0, 256, shape, np.uint8), folder)
    return folder


def change_bias(network: IntegerNetwork) -> IntegerNetwork:
    """Return the network with one bias of its last convolution changed."""
    last = network.layers[-1]
    assert isinstance(last, Conv)
    bias = last.bias.copy()
    bias[0] += 1 << 20
    return replace(network, layers=(*network.layers[:-1], replace(last, bias=bias)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the export of a small random network."""
    return write_export(random_network(SEED), tmp_path_factory.mktemp("verify") / "export")


@pytest.fixture(scope="module")
def results(folder: Path) -> dict[str, Any]:
    """Return the results of all targets, or skip where a tool is missing."""
    if absent := [tool for tool in TOOLS if shutil.which(tool) is None]:
        pytest.skip(f"no {absent[0]}")
    return run(folder, Settings(images=2, noise=2)).to_document()


@pytest.mark.slow
def test_every_target_equals_the_reference(results: dict[str, Any]) -> None:
    assert [t["target"] for t in results["targets"]] == ["gcc", "clang", "sanitizers", "riscv32"]
    assert all(t["mismatches"] == 0 for t in results["targets"])
    assert not any(t["skipped"] or t["error"] for t in results["targets"])
    assert (results["images"], results["noise_images"]) == (2, 2)


@pytest.mark.slow
def test_code_size_stack_and_instructions_are_measured(results: dict[str, Any]) -> None:
    assert 500 < results["code_bytes"] < 50_000
    assert 0 < results["stack_bytes"] <= MAX_STACK_BYTES
    # At least a multiplication and an addition. Small layers have more overhead.
    assert 2 < results["instructions_per_mac"] < 60
    assert [e["images_per_s"] > 0 for e in results["gap8_estimates"]] == [True, True]
    assert all("175 MHz" in e["assuming"] for e in results["gap8_estimates"])


@pytest.mark.slow
def test_counting_instructions_gives_the_same_number_again(
    results: dict[str, Any], folder: Path
) -> None:
    again = run(folder, replace(GCC, targets=())).to_document()
    assert again["instructions"] == results["instructions"]


@pytest.fixture
def single_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile at one level and skip the cost measurement, which the slow tests do."""
    monkeypatch.setattr(compile_targets, "OPTIMIZATION_LEVELS", ("-O0",))
    monkeypatch.setattr(measure, "measure_cost", lambda *_: ExecutionCost())


@pytest.mark.heavy
@needs_gcc
@pytest.mark.usefixtures("single_compilation")
def test_c_of_another_network_is_detected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = random_network(SEED)
    wrong = write_export(network, tmp_path / "export", carries=change_bias(network))
    assert app(["verify", str(wrong), "--targets", "gcc", "--json"], result_action="return_value")
    (gcc,) = json.loads(capsys.readouterr().out)["targets"]
    assert gcc["mismatches"] > 0
    assert not gcc["error"]


@pytest.mark.heavy
@needs_gcc
@pytest.mark.usefixtures("single_compilation")
def test_a_proof_is_written_only_where_the_c_is_right(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "proof.json"
    run(folder, GCC, out)
    assert json.loads(out.read_text())["targets"][0]["mismatches"] == 0
    network = random_network(SEED)
    wrong = write_export(network, tmp_path / "export", carries=change_bias(network))
    with pytest.raises(ToolError, match=r"gcc: \d+ images differ from the reference"):
        run(wrong, GCC, tmp_path / "lie.json")
    assert sorted(p.name for p in tmp_path.glob("*.json*")) == ["proof.json"]


def test_required_but_missing_target_gives_no_proof(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ToolError, match="gcc not tried"):
        run(folder, replace(GCC, require=True), tmp_path / "proof.json")


@needs_gcc
@pytest.mark.heavy
def test_c_that_does_not_compile_is_an_error_of_its_target(folder: Path, tmp_path: Path) -> None:
    broken = tmp_path / "export"
    shutil.copytree(folder, broken)
    text = (broken / "random.c").read_text()
    (broken / "random.c").write_text(text[: len(text) // 2])
    result = run(broken, replace(GCC, targets=("sanitizers",)))
    assert result.wrong
    assert "error" in result.targets[0].error


def test_targets_without_tools_are_skipped_and_reported(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["verify", str(folder), "--images", "1", "--noise", "0"]
    assert app(words, result_action="return_value") == 0
    output = capsys.readouterr().out
    assert output.count("skipped: no ") == 4
    assert "apt-get install gcc-riscv64-unknown-elf" in output
    assert "apt-get install clang" in output
    assert app([*words, "--require"], result_action="return_value") == 1


def test_an_empty_folder_is_no_export(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=str(tmp_path)):
        run(tmp_path, GCC)


@pytest.mark.parametrize("name", ["random.c", "random.h", INTEGER_NAME])
@pytest.mark.parametrize("damage", ["removed", "emptied"])
def test_a_damaged_export_is_named(folder: Path, tmp_path: Path, name: str, damage: str) -> None:
    broken = tmp_path / "export"
    shutil.copytree(folder, broken)
    (broken / name).unlink()
    if damage == "emptied":
        (broken / name).touch()
    with pytest.raises(ModelError, match="export"):
        run(broken, GCC)


def test_images_of_another_size_are_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "export"
    shutil.copytree(folder, other)
    save_samples(np.zeros((1, 8, 8, 3), np.uint8), other)
    with pytest.raises(SettingError, match="8 x 8 px"):
        run(other, GCC)


def test_no_images_at_all_are_refused(folder: Path) -> None:
    with pytest.raises(SettingError, match="no images"):
        run(folder, replace(GCC, images=0, noise=0))


def test_a_folder_that_is_no_dataset_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError):
        run(folder, replace(GCC, dataset=tmp_path))
