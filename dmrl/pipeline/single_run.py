"""One run of a stage on a cluster, for one output."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmrl.atomic_output import register_output
from dmrl.errors import DmrlError, SettingError
from dmrl.pipeline.batch import Task, error_text, find_changed_settings
from dmrl.pipeline.executor import open_executor
from dmrl.pipeline.job import build_job, has_failed
from dmrl.pipeline.stage_signature import signature_of


def run_on_cluster(
    on: str, stage: str, out: Path | None, inputs: Mapping[str, Any], settings: Any = None
) -> dict[str, Any] | None:
    """Run a stage once, on a cluster.

    Parameters
    ----------
    on
        See `open_executor`.
    stage, out
        Command name, and its output.
    inputs
        Arguments of its ``run`` without the settings, by name.
    settings
        Settings of the stage.

    Returns
    -------
    dict or None
        Result of ``run``, as JSON values. None: the output existed, made of the same inputs.

    Raises
    ------
    DmrlError
        If the stage fails.
    """
    if out is None:
        raise SettingError(
            f"dmrl {stage} --on needs an output. Name a folder for its figures: --plots DIR"
        )
    line = build_job(stage, out, dict(inputs), find_changed_settings(settings), keep=True)
    task = Task(out, out, line)
    with open_executor(on, None) as crew:
        answer = crew.submit(line, exclusive=signature_of(stage).exclusive).result()
    if has_failed(answer):
        raise DmrlError(error_text(task, answer))
    register_output(out)
    return None if "up_to_date" in answer else answer["result"]
