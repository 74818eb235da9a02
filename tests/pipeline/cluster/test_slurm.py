"""A plan as a Slurm array job: each element does its part, and a repeated command finds it done."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from dmrl.errors import OutputError, SettingError
from dmrl.pipeline.batch import run_over_folder
from dmrl.pipeline.cluster import slurm
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.stages import trim

from ..test_batch import bytes_in, record

KEPT = trim.Settings(to_s=1.5)


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    for k in range(3):
        record(tmp_path / "flights with spaces" / f"{k}.mcap", roll_rad=k)
    return tmp_path / "flights with spaces"


def run(script: Path, element: int) -> subprocess.CompletedProcess[str]:
    """An element, as Slurm runs it."""
    own = os.environ | {"SLURM_ARRAY_TASK_ID": str(element)}
    return subprocess.run(["sh", str(script)], env=own, capture_output=True, text=True, check=False)


@pytest.mark.heavy
def test_slurm_array_outputs_equal_local_outputs(
    flights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(slurm, "MAX_ELEMENTS", 2)
    out = tmp_path / "out"
    run_over_folder("trim", flights, out, KEPT, workers=None, on="slurm")
    output = capsys.readouterr().out
    script = out / ".dmrl-job.sh"
    assert output == f"3 tasks in 2 elements. Now: sbatch {script}\n"
    assert "#SBATCH --array=0-1\n" in script.read_text()
    assert not list(out.glob("*.mcap"))
    first = run(script, 0)
    assert first.returncode == 0 and len(first.stdout.splitlines()) == 2
    assert [p.name for p in sorted(out.glob("*.mcap"))] == ["0.mcap", "2.mcap"]
    (flights / "1.mcap").rename(flights / "gone")
    bad = run(script, 1)
    assert bad.returncode == 1 and "error" in json.loads(bad.stdout)
    (flights / "gone").rename(flights / "1.mcap")
    assert run(script, 1).returncode == 0
    run_over_folder("trim", flights, out, KEPT, workers=1)
    assert capsys.readouterr().out.count("was there") == 3
    run_over_folder("trim", flights, tmp_path / "here", KEPT, workers=1)
    made = {name: data for name, data in bytes_in(out).items() if name.endswith(".mcap")}
    assert made == bytes_in(tmp_path / "here")


@pytest.mark.heavy
def test_names_that_a_shell_would_run_are_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of recordings, and of the folder that the job is begun in."""
    here = tmp_path / "it's $(touch victim)\n#SBATCH --wrap=x\ntouch victim #"
    here.mkdir()
    names = {"$(touch victim).mcap", "`touch victim`.mcap", "a'b\"c.mcap", "-rf.mcap", "n\nl.mcap"}
    names |= {"a;touch victim.mcap", "\u2028.mcap"}
    for k, name in enumerate(sorted(names)):
        record(here / "flights" / name, roll_rad=k)
    monkeypatch.chdir(here)
    monkeypatch.setattr(slurm, "MAX_ELEMENTS", 1)
    out = tmp_path / "out"
    run_over_folder("trim", Path("flights"), out, KEPT, workers=None, on="slurm")
    script = out / ".dmrl-job.sh"
    lines = script.read_text().splitlines()
    until = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    assert until == 5 and (out / ".dmrl-tasks.jsonl").read_text().count("\n") == len(names)
    done = run(script, 0)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in out.glob("*.mcap")} == names
    assert not list(tmp_path.rglob("victim"))


def test_single_output_is_refused_as_slurm_array(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--on slurm is for a folder"):
        run_on_cluster("slurm", "fly", tmp_path / "a.mcap", {}, None)


@pytest.mark.parametrize("name", ["a b", "a\ntouch victim", "a%j", "a;b", "$(a)"])
def test_a_folder_whose_name_slurm_would_read_otherwise_is_refused(
    name: str, tmp_path: Path
) -> None:
    """What stands behind a line end in the script would be run."""
    (tmp_path / name).mkdir()
    with pytest.raises(OutputError, match="Name another folder"):
        slurm.write_array_job([], tmp_path / name)
    assert list((tmp_path / name).iterdir()) == []
