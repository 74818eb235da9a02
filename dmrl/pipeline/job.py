"""One run of a stage as a line of JSON, which any process can do: see `dmrl.pipeline.job_worker`."""

import json
from pathlib import Path
from typing import Any

Answer = dict[str, Any]
"""What became of a job.

==========  ==================================================================
key         is there
==========  ==================================================================
``sha256``  of the output, once it is made
``result``  in place of it, where the job asked: what ``run`` gave back
``there``   in place of both: the output was there, made of the same
``error``   what a user can mend
``again``   beside it, "elsewhere": another machine may do it, as where a disk is full;
            "later": another process is at it
``fault``   what only we can
==========  ==================================================================
"""


def job(
    stage: str,
    out: Path | None,
    inputs: dict[str, Any],
    settings: dict[str, Any],
    *,
    resume: bool = False,
    keep: bool = False,
) -> str:
    """One line that `dmrl.pipeline.job_worker.perform` understands.

    Parameters
    ----------
    stage
        Command name, such as "label".
    out
        What it writes; None: nothing.
    inputs
        Paths by the names of ``run``'s arguments.
    settings
        Keys of its settings, and of other arguments.
    resume
        Go on with what a killed run has left.
    keep
        An output that was made of the same inputs by the same settings is left as it is. The
        answer has the result then, and no hash of the output.
    """
    told = {"stage": stage, "out": out, "inputs": inputs, "settings": settings}
    return json.dumps({**told, "resume": resume, "keep": keep}, default=str)


def failed(answer: Answer) -> bool:
    """Whether there is nothing to show for a job."""
    return "error" in answer or "fault" in answer
