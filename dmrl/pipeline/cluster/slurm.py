"""A plan as an array job of Slurm: the same lines, each done by `main` here on a node of its own.

Lines and the script are written beside the outputs. When the job has run, the same command without
``--on`` says what became of each: what is whole is left as it is, what is not is made.
"""

import json
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from dmrl.atomic_output import rewritten_file
from dmrl.errors import OutputError, SettingError, one_line
from dmrl.pipeline.job import failed
from dmrl.pipeline.job_worker import perform
from dmrl.pipeline.process_pool import ONE_THREAD
from dmrl.storage import Remote

PLAIN = re.compile(r"[\w/.+@=-]+")
"""Of a line for Slurm: a space would end the path, and a line end would begin a command."""
MOST = 1000
"""Elements of an array: Slurm takes 1,001 unless told. With more tasks, each does some."""
SCRIPT = """#!/bin/sh
#SBATCH --job-name=dmrl
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --output={out}/.dmrl-%a.log
cd {here} || exit 1
export {threads}
exec {python} -P -m dmrl.pipeline.cluster.slurm {lines} "$SLURM_ARRAY_TASK_ID" {elements}
"""


class Line(Protocol):
    """A task."""

    @property
    def line(self) -> str:
        """As `dmrl.pipeline.job_worker.perform` takes it."""


def array_job(tasks: Sequence[Line], out: Path) -> str:
    """Write the job of some tasks; the line to type.

    Parameters
    ----------
    tasks
        What is to be done.
    out
        Folder of the outputs.

    Raises
    ------
    OutputError
        If the job cannot be written, or the folder's path cannot stand in a line of Slurm's.
    SettingError
        If the outputs go into a bucket.
    """
    if isinstance(out, Remote):
        raise SettingError(f"Slurm's nodes read their tasks beside {out}. Name a folder they share")
    if not PLAIN.fullmatch(str(out.absolute())):
        raise OutputError(
            f"{out.absolute()}: Slurm takes paths of letters, digits and /._+@=- alone. "
            "Name another folder"
        )
    lines, script = out / ".dmrl-tasks.jsonl", out / ".dmrl-job.sh"
    elements = min(len(tasks), MOST)
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
        with rewritten_file(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return f"{len(tasks)} tasks in {elements} elements. Now: sbatch {shlex.quote(str(script))}"


def main() -> int:
    """Do the tasks of one element; their answers are printed, a line each."""
    lines, element, elements = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    bad = 0
    with lines.open(encoding="utf-8") as stream:
        for number, line in enumerate(stream):
            if number % elements == element:
                answer = perform(line)
                bad += failed(answer)
                sys.stdout.write(one_line(json.dumps(answer)) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
