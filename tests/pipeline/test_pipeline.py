"""Pipelines in several processes: equal bytes, kills, and the ownership of their folder."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dmrl.errors import DmrlError, OutputError, RecipeError, SettingError
from dmrl.evaluation.pipeline_summary import print_report
from dmrl.pipeline import job_worker as work
from dmrl.pipeline import recipe_run as pipeline
from dmrl.pipeline.job import build_job
from dmrl.pipeline.process_pool import ProcessPool

SMALL = """
kind = "pipeline"
step = [
  { stage = "sketch", images = 2, seed = "{n}", out = "pictures-{n}" },
  { stage = "convert", source = "pictures-{n}", out = "{n}.mcap" },
  { stage = "merge", recordings = "{n}.mcap", out = "all.mcap" },
  { stage = "trim", recording = "all.mcap", from_s = 0.05, out = "end.mcap" },
]
each = { n = "1-2" }
"""


def write_recipe(folder: Path, text: str) -> Path:
    """Write a recipe."""
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def read_outputs(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file that steps wrote, by relative path."""
    own = {"pipeline.json", "recipe.toml"}
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in own)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.heavy
def test_a_pipeline_gives_the_same_bytes_with_any_number_of_workers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, one, two = write_recipe(tmp_path, SMALL), tmp_path / "one", tmp_path / "two"
    pipeline.run(recipe, one, workers=1)
    done = pipeline.run(recipe, two, workers=2)
    assert not any(d.skipped for d in done)
    outs = {"1.mcap", "2.mcap", "all.mcap", "end.mcap", "pictures-1", "pictures-2"}
    assert {p.name for p in two.iterdir()} == outs | {"pipeline.json", "recipe.toml"}
    assert read_outputs(one) == read_outputs(two)
    assert (two / "recipe.toml").read_text() == SMALL
    capsys.readouterr()
    again = pipeline.run(recipe, two)
    assert [d.skipped for d in again] == [True] * 6
    assert capsys.readouterr().err == "6 of 6 steps were up to date\n"
    print_report(again, as_json=True)
    assert len(json.loads(capsys.readouterr().out)["steps"]) == 6


@pytest.mark.heavy
def test_edited_recipe_continues_in_the_same_folder(tmp_path: Path) -> None:
    recipe, out = (
        write_recipe(tmp_path, SMALL.replace("from_s = 0.05", "from_s = 99.0")),
        tmp_path / "o",
    )
    with pytest.raises(DmrlError, match=r"^end\.mcap \(trim\): "):
        pipeline.run(recipe, out, workers=2)
    assert (out / "all.mcap").is_file() and not (out / "end.mcap").exists()
    done = pipeline.run(write_recipe(tmp_path, f"# {SMALL}"), out, workers=2)
    assert [d.stage for d in done if not d.skipped] == ["trim"]


def test_missing_data_is_an_error_before_any_step(tmp_path: Path) -> None:
    text = SMALL.replace('source = "pictures-{n}"', 'source = "{data}/{n}"')
    recipe, data, out = write_recipe(tmp_path, text), tmp_path / "data", tmp_path / "out"
    with pytest.raises(SettingError, match="Say where: --data DIR"):
        pipeline.run(recipe, out)
    with pytest.raises(SettingError, match="no folder"):
        pipeline.run(recipe, out, data)
    data.mkdir()
    with pytest.raises(SettingError, match=r"no .*data/1 and 1 more that .* reads"):
        pipeline.run(recipe, out, data)
    with pytest.raises(RecipeError, match="leads out of its folder"):
        pipeline.run(write_recipe(tmp_path, text.replace("{data}/", "{data}/../")), out, data)
    assert not out.exists()


def test_foreign_folder_is_not_overwritten(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "recipe.toml").write_text("mine")
    with pytest.raises(OutputError, match="is not empty"):
        pipeline.run(write_recipe(tmp_path, SMALL), foreign)
    assert [p.name for p in foreign.iterdir()] == ["recipe.toml"]
    with pytest.raises(OutputError, match=r"is a file\. Name a folder"):
        pipeline.run(write_recipe(tmp_path, SMALL), foreign / "recipe.toml")


ONE = 'kind = "pipeline"\n[[step]]\nstage = "sketch"\nout = "pictures"\nimages = 1\n'


@pytest.mark.heavy
def test_partial_files_of_a_failed_start_do_not_block_the_folder(tmp_path: Path) -> None:
    """Such files are left if a full disk lets the first file be neither finished nor removed."""
    out = tmp_path / "out"
    (out / "unfinished").mkdir(parents=True)
    (out / "pipeline.json.partial").write_text("{")
    (done,) = pipeline.run(write_recipe(tmp_path, ONE), out, workers=1)
    assert not done.skipped
    assert {p.name for p in out.iterdir()} == {"pictures", "pipeline.json", "recipe.toml"}


def test_os_error_in_a_step_is_no_internal_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def raise_os_error(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error", "a.png")

    monkeypatch.setattr(work, "signature_of", raise_os_error)
    answer = work.run_job(build_job("sketch", None, {}, {}))
    assert answer == {
        "error": "cannot read or write a.png: Input/output error. Check its name, permissions and "
        "free space"
    }


LONG = SMALL.replace("images = 2", "images = 900")
"""A recipe that takes long enough to be killed."""


def start_run(recipe: Path, out: Path) -> tuple["subprocess.Popen[str]", list[int]]:
    """Start a run, wait until it works on two steps, and return it with its worker processes."""
    command = [sys.executable, "-m", "dmrl.cli", "run", str(recipe), "--out", str(out)]
    running = subprocess.Popen(
        [*command, "--workers", "2"],
        stderr=subprocess.PIPE,
        text=True,
        # A shell's background jobs inherit an ignored SIGINT; a run at a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    places = [out / "unfinished" / f"pictures-{n}.partial" for n in (1, 2)]
    while not all(place.exists() for place in places):
        assert running.poll() is None, running.communicate()
        time.sleep(0.05)
    return running, list_children(running.pid)


def list_children(parent: int) -> list[int]:
    """Return the process IDs of the children of a process, which any of its threads started."""
    tasks = Path(f"/proc/{parent}/task").glob("*/children")
    return [int(number) for task in tasks for number in task.read_text().split()]


def is_process_gone(number: int) -> bool:
    """Return whether a process does not exist or is a zombie."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.heavy
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_a_run_that_is_stopped(tmp_path: Path, number: signal.Signals) -> None:
    recipe, out = write_recipe(tmp_path, LONG), tmp_path / "out"
    running, workers = start_run(recipe, out)
    assert len(workers) == 2
    with pytest.raises(OutputError, match="another dmrl run is at work"):
        pipeline.run(recipe, out)
    running.send_signal(number)
    _, output = running.communicate()
    assert running.returncode in (130, -signal.SIGKILL)
    while not all(map(is_process_gone, workers)):
        time.sleep(0.05)
    assert "Traceback" not in output
    killed = number == signal.SIGKILL
    assert (out / "unfinished").exists() == killed  # an interrupted run removes it
    done = pipeline.run(write_recipe(tmp_path, SMALL), out, workers=2)
    assert not any(d.skipped for d in done) and not (out / "unfinished").exists()


@pytest.mark.heavy
def test_killed_worker_gives_one_line_error(tmp_path: Path) -> None:
    before = set(list_children(os.getpid()))
    with ProcessPool(1) as crew:
        line = build_job("sketch", tmp_path / "a", {}, {"images": 9000}, resume=False)
        answer = crew.submit(line, exclusive=False)
        while not (tmp_path / "a.partial").exists():
            time.sleep(0.05)
        (worker,) = set(list_children(os.getpid())) - before
        os.kill(worker, signal.SIGKILL)
        assert answer.result()["error"].startswith("its process was killed (signal 9)")
        line = build_job("sketch", tmp_path / "b", {}, {"images": 1}, resume=False)
        assert crew.submit(line, exclusive=False).result().keys() == {"sha256"}


@pytest.mark.heavy
def test_user_errors_and_internal_errors_are_distinguished(tmp_path: Path) -> None:
    with ProcessPool(1) as crew:
        wrong = build_job("convert", tmp_path / "a", {"source": tmp_path / "no"}, {}, resume=False)
        assert crew.submit(wrong, exclusive=False).result().keys() == {"error"}
        broken = build_job("convert", tmp_path / "a", {"sauce": tmp_path / "no"}, {}, resume=False)
        assert crew.submit(broken, exclusive=False).result()["bug"].startswith("TypeError: ")
