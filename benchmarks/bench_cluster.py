"""Many recordings here and on Ray: the speed-up on this machine's cores, and what a task costs.

    dmrl fly fly_in_view flights/0.mcap --duration-s 8 --seed 0    (and so on: some dozens)
    python benchmarks/bench_cluster.py flights

`dmrl label` of the folder with one process, with one for each core, as Ray tasks on a cluster that
is begun and ended for it, and on two nodes of a core each that are there already; then `dmrl trim`
of one small recording many times, which is all overhead. Wall times are of a machine as busy as it
is: the load is printed. CPU is of this process, which hands the tasks out, and so bounds how many
tasks a second can be begun, wherever they run.
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


def spent(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the clock, and of this process's CPU."""
    begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        work()
    return time.perf_counter() - begun_s, time.process_time() - begun_cpu_s


@contextmanager
def nodes(count: int) -> Iterator[None]:
    """Start a cluster of one-core nodes on this machine, which ``--on ray`` finds."""
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


def labels(flights: Path, out: Path) -> list[tuple[str, float, float]]:
    """Seconds of labelling all of it, and how many times faster than one process."""
    ways = {
        "one process": {"workers": 1},
        f"{count_cores()} processes": {"workers": None},
        f"Ray, {count_cores()} cores": {"workers": None, "on": "ray"},
    }
    took = {}
    for name, how in ways.items():
        took[name] = spent(
            lambda name=name, how=how: run_over_folder("label", flights, out / name, **how)
        )  # type: ignore[misc,arg-type]
    with nodes(2):
        took["Ray, two nodes"] = spent(
            lambda: run_over_folder("label", flights, out / "nodes", workers=None, on="ray")
        )
    first_s = took["one process"][0]
    return [(name, wall_s, first_s / wall_s) for name, (wall_s, _) in took.items()]


def overhead(folder: Path, on: str | None) -> tuple[float, float]:
    """Milliseconds by the clock, and of this process's CPU, for each of many small tasks."""
    source = folder / "small.mcap"
    if not source.exists():
        with RecordingWriter(source, Provenance("bench")) as sink:
            sink.write(0, ATTITUDE("cf1"), message_class("Attitude")())
    found = {Path(f"{k}.mcap"): source for k in range(TASKS)}
    out = folder / (on or "here")
    out.mkdir()
    tasks = build_tasks("trim", "recording", found, out)
    with open_executor(on, None) as crew:
        crew.submit(tasks[0].line, alone=False).result()  # a process is there
        wall_s, cpu_s = spent(
            lambda: [one.result() for one in [crew.submit(t.line, alone=False) for t in tasks[1:]]]
        )
    return 1e3 * wall_s / TASKS, 1e3 * cpu_s / TASKS


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flights", type=Path)
    flights = parser.parse_args().flights
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        load = os.getloadavg()[0]
        rows = [(f"here, {count_cores()} processes", *overhead(folder, None))]
        rows.append((f"Ray, {count_cores()} cores", *overhead(folder, "ray")))
        print_table("a task", ("on", "ms by the clock", "ms of CPU here"), rows)
        title = f"label of {len(list(flights.glob('*.mcap')))} recordings, load {load:.1f}"
        print_table(title, ("with", "s", "times faster"), labels(flights, folder))


if __name__ == "__main__":
    main()
