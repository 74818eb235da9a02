"""One run of a stage on a cluster, for one output."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmrl.atomic_output import note
from dmrl.errors import DmrlError, SettingError
from dmrl.pipeline.batch import Task, differing, words_of
from dmrl.pipeline.executor import SLURM, executor
from dmrl.pipeline.job import failed, job
from dmrl.pipeline.stage_signature import interface_of


def done_on(
    on: str, stage: str, out: Path | None, inputs: Mapping[str, Any], settings: Any = None
) -> dict[str, Any] | None:
    """Run a stage once, on a cluster.

    Parameters
    ----------
    on
        See `executor`.
    stage, out
        Command name, and what it writes.
    inputs
        Arguments of its ``run`` but for the settings, by name.
    settings
        Its settings.

    Returns
    -------
    dict or None
        What ``run`` gave back, as values of JSON. None: the output was there, made of the same.

    Raises
    ------
    DmrlError
        What the stage says.
    """
    if out is None:
        raise SettingError(
            f"dmrl {stage} --on wants an output, a folder for its figures: --plots DIR"
        )
    line = job(stage, out, dict(inputs), differing(settings), keep=True)
    task = Task(out, out, line)
    if on == SLURM:
        raise SettingError("--on slurm is for a folder of recordings. Name one, or --on ray")
    with executor(on, None) as crew:
        answer = crew.give(line, alone=interface_of(stage).alone).result()
    if failed(answer):
        raise DmrlError(words_of(task, answer))
    note(out)
    return None if "there" in answer else answer["result"]
