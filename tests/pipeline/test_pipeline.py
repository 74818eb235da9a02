"""Pipelines in processes: the same bytes, kills, and ownership of a folder."""

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


def write(folder: Path, text: str) -> Path:
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Everything that steps wrote, by name."""
    own = {"pipeline.json", "recipe.toml"}
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in own)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.heavy
def test_a_pipeline_gives_the_same_bytes_with_any_number_of_workers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, one, two = write(tmp_path, SMALL), tmp_path / "one", tmp_path / "two"
    pipeline.run(recipe, one, workers=1)
    done = pipeline.run(recipe, two, workers=2)
    assert not any(d.skipped for d in done)
    outs = {"1.mcap", "2.mcap", "all.mcap", "end.mcap", "pictures-1", "pictures-2"}
    assert {p.name for p in two.iterdir()} == outs | {"pipeline.json", "recipe.toml"}
    assert contents(one) == contents(two)
    assert (two / "recipe.toml").read_text() == SMALL
    capsys.readouterr()
    again = pipeline.run(recipe, two)
    assert [d.skipped for d in again] == [True] * 6
    assert capsys.readouterr().err == "6 of 6 steps were up to date\n"
    print_report(again, as_json=True)
    assert len(json.loads(capsys.readouterr().out)["steps"]) == 6


@pytest.mark.heavy
def test_an_edited_recipe_goes_on_in_the_same_folder(tmp_path: Path) -> None:
    recipe, out = write(tmp_path, SMALL.replace("from_s = 0.05", "from_s = 99.0")), tmp_path / "o"
    with pytest.raises(DmrlError, match=r"^end\.mcap \(trim\): "):
        pipeline.run(recipe, out, workers=2)
    assert (out / "all.mcap").is_file() and not (out / "end.mcap").exists()
    done = pipeline.run(write(tmp_path, f"# {SMALL}"), out, workers=2)
    assert [d.stage for d in done if not d.skipped] == ["trim"]


def test_missing_data_is_an_error_before_any_step(tmp_path: Path) -> None:
    text = SMALL.replace('source = "pictures-{n}"', 'source = "{data}/{n}"')
    recipe, data, out = write(tmp_path, text), tmp_path / "data", tmp_path / "out"
    with pytest.raises(SettingError, match="Say where: --data DIR"):
        pipeline.run(recipe, out)
    with pytest.raises(SettingError, match="no folder"):
        pipeline.run(recipe, out, data)
    data.mkdir()
    with pytest.raises(SettingError, match=r"no .*data/1 and 1 more that .* reads"):
        pipeline.run(recipe, out, data)
    with pytest.raises(RecipeError, match="leads out of its folder"):
        pipeline.run(write(tmp_path, text.replace("{data}/", "{data}/../")), out, data)
    assert not out.exists()


def test_foreign_folder_is_not_overwritten(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "recipe.toml").write_text("mine")
    with pytest.raises(OutputError, match="is not empty"):
        pipeline.run(write(tmp_path, SMALL), foreign)
    assert [p.name for p in foreign.iterdir()] == ["recipe.toml"]
    with pytest.raises(OutputError, match=r"is a file\. Name a folder"):
        pipeline.run(write(tmp_path, SMALL), foreign / "recipe.toml")


ONE = 'kind = "pipeline"\n[[step]]\nstage = "sketch"\nout = "pictures"\nimages = 1\n'


@pytest.mark.heavy
def test_partial_files_of_a_failed_start_do_not_block_the_folder(tmp_path: Path) -> None:
    """The first thing written could neither be finished nor removed; now the disk is well."""
    out = tmp_path / "out"
    (out / "unfinished").mkdir(parents=True)
    (out / "pipeline.json.partial").write_text("{")
    (done,) = pipeline.run(write(tmp_path, ONE), out, workers=1)
    assert not done.skipped
    assert {p.name for p in out.iterdir()} == {"pictures", "pipeline.json", "recipe.toml"}


def test_os_error_in_a_step_is_no_internal_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error", "a.png")

    monkeypatch.setattr(work, "signature_of", refused)
    answer = work.run_job(build_job("sketch", None, {}, {}))
    assert answer == {
        "error": "cannot read or write a.png: Input/output error. Check its name, permissions and "
        "free space"
    }


LONG = SMALL.replace("images = 2", "images = 900")
"""Runs for a while, and has one run at a time in a folder."""


def started(recipe: Path, out: Path) -> tuple["subprocess.Popen[str]", list[int]]:
    """A run that has begun two steps, and its processes."""
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
    return running, children(running.pid)


def children(parent: int) -> list[int]:
    """Processes that a process has started."""
    tasks = Path(f"/proc/{parent}/task").glob("*/children")
    return [int(number) for task in tasks for number in task.read_text().split()]


def is_process_gone(number: int) -> bool:
    """Whether there is no such process, or one that waits to be buried."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.heavy
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_a_run_that_is_stopped(tmp_path: Path, number: signal.Signals) -> None:
    recipe, out = write(tmp_path, LONG), tmp_path / "out"
    running, workers = started(recipe, out)
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
    assert (out / "unfinished").exists() == killed  # who is told tidies up
    done = pipeline.run(write(tmp_path, SMALL), out, workers=2)
    assert not any(d.skipped for d in done) and not (out / "unfinished").exists()


@pytest.mark.heavy
def test_killed_worker_gives_one_line_error(tmp_path: Path) -> None:
    before = set(children(os.getpid()))
    with ProcessPool(1) as crew:
        line = build_job("sketch", tmp_path / "a", {}, {"images": 9000}, resume=False)
        answer = crew.submit(line, exclusive=False)
        while not (tmp_path / "a.partial").exists():
            time.sleep(0.05)
        (worker,) = set(children(os.getpid())) - before
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
