"""One run of a stage as a line of JSON; see `dmrl.pipeline.job_worker`."""

import json
from pathlib import Path
from typing import Any

JobResult = dict[str, Any]
"""Result of a job.

==============  =============================================================
key             content
==============  =============================================================
``sha256``      hash of the output
``result``      in place of it, if the job asked for it: the result of ``run``
``left_out``    beside it: counts of what was left out, by reason
``up_to_date``  in place of both: the output existed, made of the same inputs
``error``       a failure that the user can fix
``retry``       beside it, "elsewhere": another machine may do it, as where a disk
                is full; "later": another process writes the output
``bug``         a bug of dmrl
==============  =============================================================
"""


def build_job(
    stage: str,
    out: Path | None,
    inputs: dict[str, Any],
    settings: dict[str, Any],
    *,
    resume: bool = False,
    keep: bool = False,
) -> str:
    """Build a line for `dmrl.pipeline.job_worker.run_job`.

    Parameters
    ----------
    stage
        Command name, such as "label".
    out
        Output; None: there is none.
    inputs
        Paths by the names of ``run``'s arguments.
    settings
        Settings, and other arguments, by name.
    resume
        Whether to resume the output of a killed run.
    keep
        Whether an output that was made of the same inputs by the same settings stays. The result
        then has the return value of ``run``, and no hash of the output.
    """
    told = {"stage": stage, "out": out, "inputs": inputs, "settings": settings}
    return json.dumps({**told, "resume": resume, "keep": keep}, default=str)


def has_failed(answer: JobResult) -> bool:
    """Return whether a job failed."""
    return "error" in answer or "bug" in answer
