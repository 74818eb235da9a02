"""Run the steps of a pipeline that are not up to date: in order, independent ones in parallel."""

import shutil
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from dmrl import recipe as recipes
from dmrl.atomic_output import note, partial_of
from dmrl.errors import DmrlError, OutputError
from dmrl.evaluation.pipeline_summary import Done
from dmrl.pipeline.build_cache import Memory, key_of
from dmrl.pipeline.executor import Executor
from dmrl.pipeline.job import Answer, job
from dmrl.pipeline.plan import UNFINISHED, Plan, Step, located, makers, mapped
from dmrl.pipeline.stage_signature import NO_CONTENT
from dmrl.storage import Remote
from dmrl.terminal.progress import say


@dataclass(frozen=True, slots=True)
class Running:
    """A step at work: its key, and when it began."""

    step: Step
    key: str
    begun_s: float


class Runner:
    """One run of a pipeline.

    Parameters
    ----------
    plan
        Its steps.
    folder
        Of all outputs.
    data
        What ``{data}`` stands for.
    memory
        Of the folder.
    crew
        Who does the steps.
    """

    def __init__(
        self, plan: Plan, folder: Path, data: Path | None, memory: Memory, crew: Executor
    ) -> None:
        self.folder, self.data, self.memory, self.crew = folder, data, memory, crew
        self.steps = {step.out: step for step in plan.steps}
        self.outs = set(self.steps)
        self.order = plan.order
        self.running: dict[Future[Answer], Running] = {}
        self.done: dict[str, Done] = {}
        self.failed: list[DmrlError] = []
        self._places = {out: k for k, out in enumerate(self.steps)}

    def run(self) -> list[Done]:
        """What became of every step, in the order of the recipe.

        Raises
        ------
        DmrlError
            What the first step that failed says. Steps beside it were finished.
        """
        self.order.prepare()
        ready: deque[tuple[Step, str]] = deque()
        while self.order.is_active():
            while fresh := sorted(self.order.get_ready(), key=self._places.__getitem__):
                ready.extend(found for out in fresh if (found := self._to_do(self.steps[out])))
            while ready and not self.failed and self._has_room(ready[0][0]):
                self._start(*ready.popleft())
            if self.running:
                over = wait(self.running, return_when=FIRST_COMPLETED).done
                self._finish(
                    *sorted(over, key=lambda one: self._places[self.running[one].step.out])
                )
            elif self.failed:
                break
        for error in self.failed[1:]:
            say(f"also: {error}")
        if self.failed:
            raise self.failed[0]
        return [self.done[out] for out in self.steps]

    def _to_do(self, step: Step) -> tuple[Step, str] | None:
        """A step and its key; None, if there is nothing to do for it."""
        out = self.folder / step.out
        if missing := [n for n in makers(step.names, self.outs) if self.done[n].left_out]:
            self._fail(step, f"reads {missing[0]}, which was left out. Mend that first")
            return None
        try:
            key = self._key(step)
            made = self.memory.is_made(out, key)
        except OSError as e:
            self._fail(step, f"cannot read {e.filename}: {e.strerror}. Check it")
            return None
        if made:
            self._end(step, Done(step.stage, out, 0.0, skipped=True))
            return None
        if out.exists() and not {step.out} & (self.memory.done.keys() | self.memory.begun.keys()):
            raise OutputError(f"{out} is there, and not of this pipeline. Move it elsewhere")
        return step, key

    def _key(self, step: Step) -> str:
        """What decides the bytes of a step's output."""
        takes = step.interface
        own = {k: v for k, v in step.settings.items() if k not in takes.others}
        filled: dict[str, Any] = {k: step.settings[k] for k in takes.others}
        if takes.settings is not None:
            filled |= asdict(recipes.check(step.out, own, takes.settings))
        filled |= mapped(step.path_settings, self._content)
        matter = {k: v for k, v in recipes.plain(filled).items() if k not in NO_CONTENT}
        return key_of(step.stage, matter, mapped(dict(step.inputs), self._content))

    def _content(self, name: str) -> list[str]:
        """Name and SHA-256 of what a step reads; the name alone, where it is known as such."""
        path = self._located(name)
        return [path.name, self.memory.sha256(path)] if path.exists() else [name]

    def _located(self, name: str) -> Path:
        return located(name, self.outs, self.folder, self.data)

    def _has_room(self, step: Step) -> bool:
        blocks = self.crew.alone_blocks
        if blocks and any(one.step.interface.alone for one in self.running.values()):
            return False
        alone = blocks and step.interface.alone
        return len(self.running) < (1 if alone else self.crew.workers)

    def _start(self, step: Step, key: str) -> None:
        place = self.folder / UNFINISHED / step.out
        same = self.memory.begun.get(step.out) == key
        if place.exists() and same:  # whole, but we were killed before it had its name
            self._adopt(Running(step, key, perf_counter()), self.memory.sha256(place))
            return
        partial = partial_of(place)
        _remove(place)
        if step.interface.resumes and not same:
            _remove(partial)
        self.memory.begun[step.out] = key
        self.memory.save()
        say(
            f"[{len(self.done) + len(self.running) + 1}/{len(self.steps)}] {step.stage}: {step.out}"
        )
        line = job(
            step.stage,
            place,
            mapped(dict(step.inputs), lambda name: str(self._located(name))),
            {**step.settings, **mapped(step.path_settings, lambda n: str(self._located(n)))},
            resume=partial.exists(),
        )
        future = self.crew.give(line, alone=step.interface.alone)
        self.running[future] = Running(step, key, perf_counter())

    def _finish(self, *futures: Future[Answer]) -> None:
        for future in futures:
            one = self.running.pop(future)
            answer = future.result()
            if "sha256" in answer:
                self._adopt(one, answer["sha256"])
            elif "fault" in answer:
                raise RuntimeError(f"{one.step.out} ({one.step.stage}): {answer['fault']}")
            else:
                self._fail(one.step, answer["error"])

    def _adopt(self, one: Running, sha256: str) -> None:
        """Give a whole output its name, in place of the one before."""
        out, new = self.folder / one.step.out, self.folder / UNFINISHED / one.step.out
        if isinstance(out, Remote):
            new.replace(out)
        elif out.is_dir() or (out.exists() and new.is_dir()):
            old = new.with_name(f"{new.name}.old")
            _remove(old)
            out.rename(old)
            new.rename(out)
            _remove(old)
        else:
            new.replace(out)
        note(out)
        self.memory.done[one.step.out] = [one.key, sha256]
        self.memory.know(out, sha256)
        self.memory.save()
        seconds = perf_counter() - one.begun_s
        self._end(one.step, Done(one.step.stage, out, seconds, skipped=False))

    def _end(self, step: Step, done: Done) -> None:
        self.done[step.out] = done
        self.order.done(step.out)

    def _fail(self, step: Step, words: str) -> None:
        """Note that a step failed, or go on without it."""
        if not step.optional:
            self.failed.append(DmrlError(f"{step.out} ({step.stage}): {words}"))
            return
        say(f"{step.out} ({step.stage}) is left out. {words}")
        out = self.folder / step.out
        self._end(step, Done(step.stage, out, 0.0, skipped=False, left_out=True))


def _remove(path: Path) -> None:
    if isinstance(path, Remote):
        path.remove_all()
    elif path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
