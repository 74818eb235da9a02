"""Runner of a pipeline: builds outdated outputs in order, independent ones in parallel."""

import shutil
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any

from dmrl import __version__
from dmrl import recipe as recipes
from dmrl.atomic_output import register_output, to_partial_path
from dmrl.errors import DmrlError, OutputError
from dmrl.evaluation.pipeline_summary import StepOutcome
from dmrl.pipeline.build_cache import BuildCache, build_key
from dmrl.pipeline.executor import Executor
from dmrl.pipeline.job import JobResult, build_job
from dmrl.pipeline.plan import (
    PREVIOUS,
    UNFINISHED,
    Plan,
    Step,
    find_producers,
    locate_input,
    map_strings,
)
from dmrl.pipeline.stage_signature import SETTINGS_WITHOUT_EFFECT
from dmrl.storage import RemotePath
from dmrl.terminal.progress import say


@dataclass(frozen=True, slots=True)
class RunningStep:
    """A running step, its key, and its start time."""

    step: Step
    key: str
    begun_s: float


class Runner:
    """One run of a pipeline.

    Parameters
    ----------
    plan
        Steps of the pipeline.
    folder
        Folder of all outputs.
    data
        Folder that replaces ``{data}``.
    memory
        Cache of the folder.
    before_output
        Called before a new output gets its name.
    """

    crew: Executor

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        data: Path | None,
        memory: BuildCache,
        *,
        before_output: Callable[[], object] = lambda: None,
    ) -> None:
        self._before_output = before_output
        self.folder, self.data, self.memory = folder, data, memory
        self.steps = {step.out: step for step in plan.steps}
        self.outs = set(self.steps)
        self.order = plan.order
        self.running: dict[Future[JobResult], RunningStep] = {}
        self.done: dict[str, StepOutcome] = {}
        self.failed: list[DmrlError] = []
        self._made_of: dict[str, dict[str, Any]] = {}
        self._places = {out: k for k, out in enumerate(self.steps)}

    def run(self, crew: Executor) -> list[StepOutcome]:
        """Run all steps by an executor; return their outcomes in the order of the recipe.

        Raises
        ------
        DmrlError
            The error of the first step that failed. Steps beside it were finished.
        """
        self.crew = crew
        self.order.prepare()
        ready: deque[tuple[Step, str]] = deque()
        while self.order.is_active():
            while fresh := sorted(self.order.get_ready(), key=self._places.__getitem__):
                ready.extend(
                    found for out in fresh if (found := self._prepare_step(self.steps[out]))
                )
            while ready and not self.failed and self._can_start(ready[0][0]):
                self._start_step(*ready.popleft())
            if self.running:
                over = wait(self.running, return_when=FIRST_COMPLETED).done
                self._finish_steps(
                    *sorted(over, key=lambda one: self._places[self.running[one].step.out])
                )
            elif self.failed:
                break
        for error in self.failed[1:]:
            say(f"also: {error}")
        if self.failed:
            raise self.failed[0]
        return [self.done[out] for out in self.steps]

    def _prepare_step(self, step: Step) -> tuple[Step, str] | None:
        """Return a step and its key; None, if it need not run."""
        out = self.folder / step.out
        if missing := [n for n in find_producers(step.names, self.outs) if self.done[n].left_out]:
            self._fail_step(step, f"reads {missing[0]}, which was left out. Fix that first")
            return None
        try:
            self._made_of[step.out] = self.describe_step(step)
            key = build_key(self._made_of[step.out])
            made = self.memory.is_up_to_date(out, key)
        except OSError as e:
            self._fail_step(step, f"cannot read {e.filename}: {e.strerror}. Check it")
            return None
        if made:
            self._mark_done(step, StepOutcome(step.stage, out, 0.0, skipped=True))
            return None
        self.refuse_foreign_output(step)
        return step, key

    def refuse_foreign_output(self, step: Step) -> None:
        """Raise OutputError if the output exists, and this pipeline did not write it."""
        out = self.folder / step.out
        if out.exists() and not {step.out} & (self.memory.done.keys() | self.memory.begun.keys()):
            raise OutputError(f"{out} exists but this pipeline did not write it. Move or rename it")

    def describe_step(self, step: Step) -> dict[str, Any]:
        """Describe what determines the bytes of an output: stage, settings, inputs."""
        takes = step.signature
        own = {k: v for k, v in step.settings.items() if k not in takes.others}
        filled: dict[str, Any] = {k: step.settings[k] for k in takes.others}
        if takes.settings is not None:
            filled |= asdict(recipes.check(step.out, own, takes.settings))
        filled |= map_strings(step.path_settings, self._hash_input)
        plain = recipes.to_json_values(filled).items()
        matter = {k: v for k, v in plain if k not in SETTINGS_WITHOUT_EFFECT}
        inputs = map_strings(dict(step.inputs), self._hash_input)
        return {"dmrl": __version__, "stage": step.stage, "settings": matter, "inputs": inputs}

    def _hash_input(self, name: str) -> list[str]:
        """Return name and SHA-256 of an input; for a built-in name, the name alone."""
        path = self._locate(name)
        return [path.name, self.memory.get_sha256(path)] if path.exists() else [name]

    def _locate(self, name: str) -> Path:
        return locate_input(name, self.outs, self.folder, self.data)

    def _can_start(self, step: Step) -> bool:
        blocks = self.crew.exclusive_blocks
        if blocks and any(one.step.signature.exclusive for one in self.running.values()):
            return False
        exclusive = blocks and step.signature.exclusive
        return len(self.running) < (1 if exclusive else self.crew.workers)

    def _start_step(self, step: Step, key: str) -> None:
        place = self.folder / UNFINISHED / step.out
        same = self.memory.begun.get(step.out) == key
        if place.exists() and same:  # complete, but this process was killed before it got its name
            self._install_output(
                RunningStep(step, key, perf_counter()), self.memory.get_sha256(place)
            )
            return
        partial = to_partial_path(place)
        _remove_path(place)
        if step.signature.resumes and not same:
            _remove_path(partial)
        self.memory.begun[step.out] = key
        self.memory.save()
        say(
            f"[{len(self.done) + len(self.running) + 1}/{len(self.steps)}] {step.stage}: {step.out}"
        )
        line = build_job(
            step.stage,
            place,
            map_strings(dict(step.inputs), lambda name: str(self._locate(name))),
            {**step.settings, **map_strings(step.path_settings, lambda n: str(self._locate(n)))},
            resume=partial.exists(),
        )
        future = self.crew.submit(line, exclusive=step.signature.exclusive)
        self.running[future] = RunningStep(step, key, perf_counter())

    def _finish_steps(self, *futures: Future[JobResult]) -> None:
        for future in futures:
            one = self.running.pop(future)
            answer = future.result()
            if "sha256" in answer:
                self._install_output(one, answer["sha256"])
            elif "bug" in answer:
                raise RuntimeError(f"{one.step.out} ({one.step.stage}): {answer['bug']}")
            else:
                self._fail_step(one.step, answer["error"])

    def _install_output(self, one: RunningStep, sha256: str) -> None:
        """Rename a complete output to its name; the one before moves to ``previous/``."""
        out, new = self.folder / one.step.out, self.folder / UNFINISHED / one.step.out
        self._before_output()
        self.memory.done[one.step.out] = [one.key, sha256]
        self.memory.made_of[one.step.out] = self._made_of[one.step.out]
        self.memory.save()  # before the rename: a run cut off after it would build the step again
        if out.exists() or out.is_symlink():
            keep_previous(out)
        new.replace(out)
        register_output(out)
        self.memory.set_sha256(out, sha256)
        seconds = perf_counter() - one.begun_s
        self._mark_done(one.step, StepOutcome(one.step.stage, out, seconds, skipped=False))

    def _mark_done(self, step: Step, done: StepOutcome) -> None:
        self.done[step.out] = done
        self.order.done(step.out)

    def _fail_step(self, step: Step, words: str) -> None:
        """Record that a step failed, or go on without it."""
        if not step.optional:
            self.failed.append(DmrlError(f"{step.out} ({step.stage}): {words}"))
            return
        say(f"{step.out} ({step.stage}) is left out. {words}")
        out = self.folder / step.out
        self._mark_done(step, StepOutcome(step.stage, out, 0.0, skipped=False, left_out=True))


def keep_previous(path: Path) -> Path:
    """Move a file or folder into ``previous/`` beside it, under a free name; return that name."""
    folder = path.parent / PREVIOUS
    folder.mkdir(exist_ok=True)
    names = (path.name if k == 1 else f"{path.stem}.{k}{path.suffix}" for k in count(1))
    kept = next(place for name in names if not (place := folder / name).exists())
    path.replace(kept)
    return kept


def _remove_path(path: Path) -> None:
    if isinstance(path, RemotePath):
        path.remove_tree()
    elif path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
