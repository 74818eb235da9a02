"""Array jobs of Slurm: each line of a plan is run by `main` on a node of its own.

Lines and the script are written beside the outputs. When the job has run, the same command without
``--on`` prints the result of each: complete outputs stay, missing ones are made.
"""

import json
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from dmrl.atomic_output import replace_file
from dmrl.errors import OutputError, SettingError, to_one_line
from dmrl.pipeline.job import has_failed
from dmrl.pipeline.process_pool import ONE_THREAD
from dmrl.storage import RemotePath

SAFE_PATH = re.compile(r"[\w/.+@=-]+")
"""Paths that are safe in Slurm's header: a space would end the path, a line end begin a command."""
MAX_ELEMENTS = 1000
"""Most elements of an array: Slurm's default limit is 1,001. With more tasks, each runs several."""
SCRIPT = """#!/bin/sh
#SBATCH --job-name=dmrl
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --output={out}/.dmrl-%a.log
cd {here} || exit 1
export {threads}
exec {python} -P -m dmrl.pipeline.cluster.slurm {lines} "$SLURM_ARRAY_TASK_ID" {elements}
"""


class HasLine(Protocol):
    """A task."""

    @property
    def line(self) -> str:
        """Line for `dmrl.pipeline.job_worker.run_job`."""


def write_array_job(tasks: Sequence[HasLine], out: Path) -> str:
    """Write the array job of some tasks, and return the line to type.

    Parameters
    ----------
    tasks
        Tasks of the job.
    out
        Folder of the outputs.

    Raises
    ------
    OutputError
        If the job cannot be written, or the folder's path cannot stand in a line of Slurm's.
    SettingError
        If the outputs go into a bucket.
    """
    if isinstance(out, RemotePath):
        raise SettingError(f"Slurm's nodes read their tasks beside {out}. Name a folder they share")
    if not SAFE_PATH.fullmatch(str(out.absolute())):
        raise OutputError(
            f"{out.absolute()}: Slurm takes paths of letters, digits and /._+@=- alone. "
            "Name another folder"
        )
    lines, script = out / ".dmrl-tasks.jsonl", out / ".dmrl-job.sh"
    elements = min(len(tasks), MAX_ELEMENTS)
    text = SCRIPT.format(
        last=elements - 1,
        out=out.absolute(),
        here=shlex.quote(str(Path.cwd())),
        threads=" ".join(f"{name}={value}" for name, value in ONE_THREAD.items()),
        python=shlex.quote(sys.executable),
        lines=shlex.quote(str(lines.absolute())),
        elements=elements,
    )
    for path, content in ((lines, "".join(f"{task.line}\n" for task in tasks)), (script, text)):
        with replace_file(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return f"{len(tasks)} tasks in {elements} elements. Now: sbatch {shlex.quote(str(script))}"


def main() -> int:
    """Run the tasks of one element, and print a line for each result."""
    from dmrl.pipeline.job_worker import run_job  # noqa: PLC0415 - heavy, and for nodes alone

    lines, element, elements = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    bad = 0
    with lines.open(encoding="utf-8") as stream:
        for number, line in enumerate(stream):
            if number % elements == element:
                answer = run_job(line)
                bad += has_failed(answer)
                sys.stdout.write(to_one_line(json.dumps(answer)) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
