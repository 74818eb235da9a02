"""A task on a node of a cluster: done by a process of the crew's kind, which stays for the next."""

import socket
from pathlib import Path
from time import perf_counter

from dmrl.pipeline.job import Answer, failed
from dmrl.pipeline.process_pool import Process, end, environment

_idle: list[Process] = []


def perform(line: str, folder: str, *, alone: bool) -> Answer:
    """What became of a job here.

    Parameters
    ----------
    line
        As `dmrl.pipeline.job_worker.perform` takes it.
    folder
        That its names are relative to.
    alone
        It may use all cores.
    """
    begun_s = perf_counter()
    if not Path(folder).is_dir():
        words = f"{socket.gethostname()} has no folder {folder}"
        return {
            "error": f"{words}. Nodes have to see files by the same names",
            "again": "elsewhere",
        }
    process = _idle.pop() if _idle and not alone else Process(environment(alone=alone), folder)
    try:
        answer = process.answer(line)
    except KeyboardInterrupt:
        end([process], in_order=True)
        raise
    if failed(answer) or alone:
        end([process], in_order=False)  # it may hold what it should not
    else:
        _idle.append(process)
    return {**answer, "seconds": perf_counter() - begun_s}
