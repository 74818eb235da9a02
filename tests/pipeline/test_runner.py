"""Which steps are run or skipped, and what happens to earlier outputs."""

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from dmrl.atomic_output import to_partial_path
from dmrl.errors import DmrlError, OutputError
from dmrl.evaluation.pipeline_summary import StepOutcome
from dmrl.pipeline.build_cache import BuildCache
from dmrl.pipeline.job import JobResult
from dmrl.pipeline.plan import Plan, Step
from dmrl.pipeline.process_pool import ProcessPool
from dmrl.pipeline.runner import Runner
from dmrl.recording.provenance_inputs import hash_file
from dmrl.terminal.progress import Lines

A = Step("sketch", "a", settings={"seed": 1})
B = Step("sketch", "b", settings={"seed": 2})
BOTH = Step("merge", "both", {"recordings": ["a", "b"]})
LAST = Step("trim", "last", {"recording": "both"}, {"to_s": 3.0})


class FakePool(ProcessPool):
    """Runs no stage: it writes the settings and the content of the inputs as the output."""

    def __init__(self, fails: tuple[str, ...] = ()) -> None:
        super().__init__(2)
        self.jobs: list[dict[str, Any]] = []
        self.alone: list[str] = []
        self.fails = fails

    @property
    def made(self) -> list[str]:
        return [Path(job["out"]).name for job in self.jobs]

    def nodes(self) -> Lines:
        return ()

    def submit(self, job: str, *, exclusive: bool) -> Future[JobResult]:
        told = json.loads(job)
        self.jobs.append(told)
        out, answer = Path(told["out"]), Future[JobResult]()
        self.alone += [out.name] * exclusive
        if out.name in self.fails:
            answer.set_result({"error": f"no {out.name} today. Wait"})
            return answer
        read = [Path(p).read_text() for given in told["inputs"].values() for p in _list(given)]
        out.write_text(json.dumps([told["settings"], read]))
        answer.set_result({"sha256": hash_file(out)})
        return answer


def _list(given: Any) -> list[str]:
    return given if isinstance(given, list) else [given]


Run = Callable[..., tuple[list[StepOutcome], FakePool]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Return a function that runs steps in one folder, with the outputs of earlier calls."""
    (tmp_path / "unfinished").mkdir()

    def run_steps(
        *steps: Step, data: Path | None = None, **how: Any
    ) -> tuple[list[StepOutcome], FakePool]:
        with FakePool(**how) as crew:
            memory = BuildCache.load(tmp_path / "pipeline.json")
            return Runner(Plan(steps, ""), tmp_path, data, memory).run(crew), crew

    return run_steps


def test_second_run_skips_every_step(run: Run, tmp_path: Path) -> None:
    done, crew = run(A, B, BOTH, LAST)
    assert crew.made == ["a", "b", "both", "last"]
    assert [(d.stage, d.out, d.skipped) for d in done][2:] == [
        ("merge", tmp_path / "both", False),
        ("trim", tmp_path / "last", False),
    ]
    done, crew = run(A, B, BOTH, LAST)
    assert not crew.made and all(d.skipped for d in done)


def test_changed_setting_reruns_only_dependent_steps(run: Run) -> None:
    run(A, B, BOTH, LAST)
    _, crew = run(A, B, BOTH, Step(LAST.stage, "last", LAST.inputs, {"to_s": 2.0}))
    assert crew.made == ["last"]
    _, crew = run(A, Step("sketch", "b", settings={"seed": 3}), BOTH, LAST)
    assert crew.made == ["b", "both", "last"]
    same = Step("sketch", "b", settings={"seed": 3, "images": 600})  # 600 is the default
    assert not run(A, same, BOTH, Step(LAST.stage, "last", LAST.inputs, {"to_s": 3}))[1].made


def test_steps_may_be_moved_renamed_and_added_in_the_same_folder(run: Run, tmp_path: Path) -> None:
    run(A, B, BOTH)
    _, crew = run(BOTH, B, A, Step("trim", "new", {"recording": "a"}, optional=True))
    assert crew.made == ["new"]
    assert (tmp_path / "both").exists()


def test_changed_input_is_detected_by_content(run: Run, tmp_path: Path) -> None:
    data, moved = tmp_path / "data", tmp_path / "moved"
    data.mkdir()
    (data / "log").write_text("one")
    steps = (Step("convert", "x", {"source": "{data}/log"}), Step("trim", "y", {"recording": "x"}))
    assert run(*steps, data=data)[1].made == ["x", "y"]
    os.utime(data / "log", ns=(1, 1))
    assert not run(*steps, data=data)[1].made
    shutil.copytree(data, moved)
    assert not run(*steps, data=moved)[1].made
    (moved / "log").write_text("two")
    os.utime(moved / "log", ns=(1, 1))  # equal size and modification time
    assert run(*steps, data=moved)[1].made == ["x", "y"]


def test_renamed_input_counts_as_changed(run: Run, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).write_text("same")
    for name in ("one", "two"):  # the provenance has the names of inputs
        assert run(Step("convert", "x", {"source": f"{{data}}/{name}"}), data=tmp_path)[1].made


@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_text("{}")])
def test_modified_output_is_made_again(
    run: Run, tmp_path: Path, spoil: Callable[[Path], object]
) -> None:
    run(A, B, BOTH, LAST)
    spoil(tmp_path / "b")
    assert run(A, B, BOTH, LAST)[1].made == ["b"]


def test_previous_output_stays_until_the_new_one_is_complete(run: Run, tmp_path: Path) -> None:
    run(A, B, BOTH)
    before = (tmp_path / "both").read_bytes()
    with pytest.raises(DmrlError, match=r"^both \(merge\): no both today\. Wait$"):
        run(A, Step("sketch", "b", settings={"seed": 3}), BOTH, LAST, fails=("both",))
    assert (tmp_path / "both").read_bytes() == before
    assert not (tmp_path / "last").exists()
    assert run(A, Step("sketch", "b", settings={"seed": 3}), BOTH, LAST)[1].made == ["both", "last"]


def test_parallel_steps_finish_after_a_failure_and_all_failures_are_reported(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DmrlError, match=r"^a \(sketch\): no a today"):
        run(A, B, BOTH, fails=("a",))
    assert (tmp_path / "b").exists()
    with pytest.raises(DmrlError, match=r"^a \(sketch\)"):
        run(A, Step("sketch", "c"), fails=("a", "c"))
    assert "also: c (sketch): no c today" in capsys.readouterr().err


def test_failed_optional_step_blocks_its_dependents(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    maybe = Step("sketch", "a", settings={"seed": 9}, optional=True)
    run(A, B, BOTH)
    done, _ = run(maybe, B, fails=("a",))
    assert [d.left_out for d in done] == [True, False]
    assert "a (sketch) is left out. no a today" in capsys.readouterr().err
    with pytest.raises(DmrlError, match=r"both \(merge\): reads a, which was left out"):
        run(maybe, B, BOTH, fails=("a",))
    assert run(maybe, B, BOTH)[1].made == ["a", "both"]


def test_foreign_file_is_never_replaced(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a").write_text("my thesis")
    with pytest.raises(OutputError, match=r"this pipeline did not write it\. Move or rename it"):
        run(A)
    assert (tmp_path / "a").read_text() == "my thesis"


def test_output_file_replaces_a_folder_of_its_name(run: Run, tmp_path: Path) -> None:
    run(A)
    (tmp_path / "a").unlink()
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "old").touch()
    run(Step("sketch", "a", settings={"seed": 3}))
    assert (tmp_path / "a").is_file()
    assert not any((tmp_path / "unfinished").iterdir())


def test_killed_step_resumes_unless_it_changed(run: Run, tmp_path: Path) -> None:
    partial = to_partial_path(tmp_path / "unfinished" / "r.mcap")

    def render(seed: int) -> tuple[bool, bool]:
        step = Step("render", "r.mcap", settings={"seed": seed, "workers": seed})
        with pytest.raises(DmrlError), FakePool(fails=("r.mcap",)) as crew:
            memory = BuildCache.load(tmp_path / "pipeline.json")
            Runner(Plan((step,), ""), tmp_path, None, memory).run(crew)
        return crew.jobs[0]["resume"], partial.exists()

    assert render(1) == (False, False)
    partial.write_text("half")
    assert render(1) == (True, True)
    assert render(2) == (False, False)


def test_changed_number_of_workers_does_not_rerun_a_step(run: Run) -> None:
    run(Step("render", "r.mcap", settings={"workers": 1}))
    done, crew = run(Step("render", "r.mcap", settings={"workers": 2}))
    assert done[0].skipped and not crew.made


def test_output_completed_before_a_kill_is_not_made_again(run: Run, tmp_path: Path) -> None:
    run(A)
    memory = json.loads((tmp_path / "pipeline.json").read_text())
    (tmp_path / "a").rename(tmp_path / "unfinished" / "a")
    (tmp_path / "pipeline.json").write_text(json.dumps({**memory, "done": {}}))
    done, crew = run(A)
    assert not crew.made and (tmp_path / "a").is_file() and not done[0].left_out


def test_stage_with_own_processes_runs_exclusively(run: Run) -> None:
    rendered = Step("render", "r", settings={"images": 1})
    _, crew = run(A, rendered, B)
    assert crew.alone == ["r"] and crew.made == ["a", "r", "b"]


def test_damaged_build_cache_gives_one_line_error(run: Run, tmp_path: Path) -> None:
    for text in ("{", "[]", '{"done": 3}'):
        (tmp_path / "pipeline.json").write_text(text)
        with pytest.raises(OutputError, match="is damaged"):
            run(A)
