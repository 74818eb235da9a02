"""Forecast of a run: which outputs it keeps, makes or replaces, and why."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dmrl.pipeline.build_cache import build_key
from dmrl.pipeline.plan import find_producers
from dmrl.pipeline.runner import Runner

MAX_VALUE_CHARACTERS = 40
"""Length of a setting's value in a reason."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run would do about one output, and why."""

    stage: str
    out: Path
    action: Literal["keep", "make", "replace"]
    reason: str


def forecast_steps(runner: Runner) -> list[Forecast]:
    """Return a forecast of every step, in the order of the recipe. Nothing is written.

    Raises
    ------
    OutputError
        If an output exists that the pipeline did not write.
    OSError
        If an input cannot be read.
    """
    found: dict[str, Forecast] = {}
    for out in runner.order.static_order():
        step, path = runner.steps[out], runner.folder / out
        changed = [
            f"{name} is made again" if found[name].action == "replace" else f"{name} is made first"
            for name in find_producers(step.names, runner.outs)
            if found[name].action != "keep"
        ]
        if not path.exists():
            found[out] = Forecast(step.stage, path, "make", "; ".join(changed) or "it is missing")
            continue
        runner.refuse_foreign_output(step)
        if changed:
            found[out] = Forecast(step.stage, path, "replace", "; ".join(changed))
            continue
        made_of = runner.describe_step(step)
        if runner.memory.is_up_to_date(path, build_key(made_of)):
            found[out] = Forecast(step.stage, path, "keep", "up to date")
            continue
        reason = "; ".join(_iter_changes(runner.memory.made_of.get(out), made_of))
        found[out] = Forecast(step.stage, path, "replace", reason)
    return [found[out] for out in runner.steps]


def _iter_changes(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> Iterator[str]:
    """Yield the differences of what an output was made of and what it would be made of."""
    if before is None:
        yield "its settings or inputs have changed"
        return
    if before == now:
        yield "it was changed after the run"
        return
    for what in ("dmrl", "stage"):
        if before[what] != now[what]:
            yield f"{what} {before[what]} -> {now[what]}"
    for key in sorted({*before["settings"], *now["settings"]}):
        old, new = (_to_text(one["settings"].get(key)) for one in (before, now))
        if old != new:
            yield f"{key} {old} -> {new}"
    for role in sorted({*before["inputs"], *now["inputs"]}):
        if before["inputs"].get(role) != now["inputs"].get(role):
            yield f"the input {role} has changed"


def _to_text(value: Any) -> str:
    text = str(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else text[: MAX_VALUE_CHARACTERS - 3] + "..."
