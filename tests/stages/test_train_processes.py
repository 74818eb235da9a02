"""One network trained by two processes."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dmrl.errors import SettingError
from dmrl.learn.inference.loaded_model import load_model
from dmrl.stages.train import run

from .trainings import SETTINGS

TORCHRUN = """
import sys
from pathlib import Path
from dmrl.stages.train import Settings, run
run(
    Path(sys.argv[1]),
    Path(sys.argv[2]),
    Settings(epochs=2, batch_size=4, device="cpu", validation_share=0.2),
)
"""


@pytest.mark.slow
def test_two_processes_train_one_network(dots_dataset: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, validation_share=0.2)
    for name in ("a", "b"):
        run(dots_dataset, tmp_path / name, replace(settings, processes=2))
    first, second = ((tmp_path / n / "model.safetensors").read_bytes() for n in ("a", "b"))
    assert first == second
    run(dots_dataset, tmp_path / "alone", settings)
    histories = [load_model(tmp_path / n).training["history"] for n in ("a", "alone")]
    # Batches are equal, but the augmentation differs, and statistics are of half a batch each.
    assert histories[0][-1]["loss"] == pytest.approx(histories[1][-1]["loss"], rel=0.3)
    assert histories[0][-1]["loss"] != histories[1][-1]["loss"]


@pytest.mark.slow
def test_torchrun_and_two_processes_train_equal_networks(
    dots_dataset: Path, tmp_path: Path
) -> None:
    script = tmp_path / "two.py"
    script.write_text(TORCHRUN)
    words = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    done = subprocess.run(
        [sys.executable, *words, str(dots_dataset), str(tmp_path / "a")],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    run(dots_dataset, tmp_path / "b", replace(SETTINGS, validation_share=0.2, processes=2))
    first, second = ((tmp_path / n / "model.safetensors").read_bytes() for n in ("a", "b"))
    assert first == second


@pytest.mark.heavy
def test_error_of_two_processes_is_reported_once(
    dots_dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SettingError, match=r"shares: all are 0"):
        run(dots_dataset, tmp_path / "run", replace(SETTINGS, processes=2, shares={"*": 0.0}))
    assert capfd.readouterr().err == ""
    assert not (tmp_path / "run").exists()
