"""Tasks on a node of a cluster, in worker processes that stay for the next task."""

import socket
from pathlib import Path
from time import perf_counter

from dmrl.pipeline.job import JobResult, has_failed
from dmrl.pipeline.process_pool import WorkerProcess, stop_processes, worker_environment

_idle: list[WorkerProcess] = []


def run_job_here(line: str, folder: str, *, exclusive: bool) -> JobResult:
    """Run a job on this node, and return its result.

    Parameters
    ----------
    line
        Line for `dmrl.pipeline.job_worker.run_job`.
    folder
        Folder that relative names start from.
    exclusive
        Whether it may use all cores.
    """
    begun_s = perf_counter()
    if not Path(folder).is_dir():
        name = socket.gethostname()
        words = f"{name} has no folder {folder}. Nodes have to see files by the same names"
        return {"error": words, "retry": "elsewhere"}
    if _idle and not exclusive:
        process = _idle.pop()
    else:
        process = WorkerProcess(worker_environment(exclusive=exclusive), folder)
    try:
        answer = process.run_job(line)
    except KeyboardInterrupt:
        stop_processes([process], in_order=True)
        raise
    if has_failed(answer) or exclusive:
        stop_processes([process], in_order=False)  # it may hold resources that it should have freed
    else:
        _idle.append(process)
    return {**answer, "seconds": perf_counter() - begun_s}
