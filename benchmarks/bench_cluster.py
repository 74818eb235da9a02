"""Measure the speed-up of many recordings on local processes and on Ray, and the cost of a task.

    dmrl fly fly_in_view flights/0.mcap --duration-s 8 --seed 0    (and so on: some dozens)
    python benchmarks/bench_cluster.py flights

The folder is labelled by `dmrl label` in four ways: with one process, with one process per core, as
Ray tasks on a cluster started for this run, and on a running cluster of two one-core nodes. Then
`dmrl trim` processes one small recording many times, which is nearly all overhead.

Wall times depend on other load, so the load is printed. CPU time is that of this process, which
submits the tasks. It limits the tasks per second, wherever they run.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

from dmrl.messages import message_class
from dmrl.pipeline.batch import build_tasks, run_over_folder
from dmrl.pipeline.executor import open_executor
from dmrl.pipeline.process_pool import count_cores
from dmrl.recording import Provenance, RecordingWriter
from dmrl.terminal.tables import print_table
from dmrl.topics import ATTITUDE

TASKS = 200


def measure_time(work: Callable[[], object]) -> tuple[float, float]:
    """Return the wall time of some work and the CPU time of this process, seconds."""
    begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        work()
    return time.perf_counter() - begun_s, time.process_time() - begun_cpu_s


@contextmanager
def start_cluster(count: int) -> Iterator[None]:
    """Start a Ray cluster of one-core nodes on this machine; ``--on ray`` connects to it."""
    from ray.cluster_utils import Cluster  # noqa: PLC0415 - reads the environment

    node = {"num_cpus": 1, "object_store_memory": 80_000_000, "node_ip_address": "127.0.0.1"}
    node |= {"include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=dict(node))
    for _ in range(count - 1):
        cluster.add_node(**node)
    os.environ["RAY_ADDRESS"] = cluster.address
    try:
        yield
    finally:
        del os.environ["RAY_ADDRESS"]
        cluster.shutdown()


def time_labelling(flights: Path, out: Path) -> list[tuple[str, float, float]]:
    """Return the wall time to label the folder in each way, seconds, and the speed-up."""
    ways = {
        "one process": {"workers": 1},
        f"{count_cores()} processes": {"workers": None},
        f"Ray, {count_cores()} cores": {"workers": None, "on": "ray"},
    }
    took = {}
    for name, how in ways.items():
        took[name] = measure_time(
            lambda name=name, how=how: run_over_folder("label", flights, out / name, **how)
        )  # type: ignore[misc,arg-type]
    with start_cluster(2):
        took["Ray, two nodes"] = measure_time(
            lambda: run_over_folder("label", flights, out / "nodes", workers=None, on="ray")
        )
    first_s = took["one process"][0]
    return [(name, wall_s, first_s / wall_s) for name, (wall_s, _) in took.items()]


def measure_overhead(folder: Path, on: str | None) -> tuple[float, float]:
    """Return the wall time of a small task and the CPU time of this process, milliseconds."""
    source = folder / "small.mcap"
    if not source.exists():
        with RecordingWriter(source, Provenance("bench")) as sink:
            sink.write(0, ATTITUDE("cf1"), message_class("Attitude")())
    found = {Path(f"{k}.mcap"): source for k in range(TASKS)}
    out = folder / (on or "here")
    out.mkdir()
    tasks = build_tasks("trim", "recording", found, out)
    with open_executor(on, None) as crew:
        crew.submit(tasks[0].line, alone=False).result()  # the start of processes is not timed
        wall_s, cpu_s = measure_time(
            lambda: [one.result() for one in [crew.submit(t.line, alone=False) for t in tasks[1:]]]
        )
    return 1e3 * wall_s / TASKS, 1e3 * cpu_s / TASKS


def main() -> None:
    """Print the overhead of a task and the speed-up of labelling."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flights", type=Path)
    flights = parser.parse_args().flights
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        load = os.getloadavg()[0]
        rows = [(f"local, {count_cores()} processes", *measure_overhead(folder, None))]
        rows.append((f"Ray, {count_cores()} cores", *measure_overhead(folder, "ray")))
        print_table("a small task", ("executor", "wall time, ms", "CPU time here, ms"), rows)
        title = f"labelling {len(list(flights.glob('*.mcap')))} recordings, load {load:.1f}"
        rows = time_labelling(flights, folder)
        print_table(title, ("executor", "wall time, s", "speed-up"), rows)


if __name__ == "__main__":
    main()
