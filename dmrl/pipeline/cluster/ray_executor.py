"""Executor that runs tasks on the nodes of a Ray cluster.

Ray chooses a node, which runs the task in a process like those of `process_pool`, so the bytes are
the same. Nodes need access to the files by the same names, and the same version of dmrl.
"""

import os
import signal
import socket
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from dmrl import __version__
from dmrl.errors import ClusterError, optional_imports
from dmrl.guards.temporary_folder import find_system_folder
from dmrl.pipeline.job import JobResult, has_failed
from dmrl.terminal.progress import Lines, say
from dmrl.terminal.signals import TERMINATION_SIGNALS as SIGNALS

with optional_imports("cluster", "dmrl --on ray"):
    import ray
    from ray._private import ray_constants, services
    from ray.exceptions import RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

MAX_RESTARTS = 5
"""Most restarts of a task whose node or process died."""
MAX_NODES_TRIED = 3
"""Most nodes that a task is tried on, after an error of a node such as a full disk."""
OUTPUT_WAIT_S = 60.0
"""Longest wait, seconds, for an output that another task may still be writing."""
TASKS_AHEAD_PER_CORE = 4
"""Tasks per core that Ray is given at a time."""
CONNECT_TIMEOUT_S, TERMINATE_TIMEOUT_S = 10.0, 30.0
HEAD = ("node", "", "done", "failed", "s of work")
HERE, LOST = "there", "lost"
LOST_TASK = f"it was lost {MAX_RESTARTS + 1} times"


def _run_on_node(line: str, version: str, folder: str, exclusive: bool) -> JobResult:
    """Run a job on a node. Sent by value, so that it can report a missing or different dmrl."""
    import socket  # noqa: PLC0415

    import ray  # noqa: PLC0415

    name, node = socket.gethostname(), ray.get_runtime_context().get_node_id()
    try:
        import dmrl  # noqa: PLC0415
    except ImportError:
        return {"error": f"{name} has no dmrl. Install dmrl {version} there", "node": node}
    if dmrl.__version__ != version:
        words = f"{name} has dmrl {dmrl.__version__}, not {version}. Install the same everywhere"
        return {"error": words, "node": node}
    if not line:
        return {"result": "the same", "node": node}
    from dmrl.pipeline.cluster.ray_worker import run_job_here  # noqa: PLC0415

    return {**run_job_here(line, folder, exclusive=exclusive), "node": node}


_run_on_node.__module__ = "__main__"  # so that it is sent by value


class RayExecutor:
    """A cluster, for as many tasks at a time as it has cores.

    Parameters
    ----------
    address
        ``HOST:PORT`` of its Ray client server or, on one of its nodes, of its head. Empty: the
        cluster that this machine is part of, or else this machine alone.

    Raises
    ------
    ClusterError
        If nothing answers there, or a node has another version of dmrl.
    """

    exclusive_blocks = False

    def __init__(self, address: str = "") -> None:
        _connect(address)
        self._refuse_other_versions()
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._threads = ThreadPoolExecutor(TASKS_AHEAD_PER_CORE * self.workers)
        self._running: set[Any] = set()
        self._by_node: dict[str, tuple[int, int, float]] = {}
        self._known: dict[str, tuple[str, str]] = {}
        self._lock = threading.Lock()
        self._over = threading.Event()
        self.list_nodes()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._over.set()
        self._threads.shutdown(wait=False, cancel_futures=True)
        with suppress(RayError, ConnectionError):
            if self._running:
                _cancel_tasks(list(self._running))
        self._threads.shutdown()
        rows = self.list_nodes()[1:]
        ray.shutdown()
        for name, state, done, bad, work_s in rows:
            gone = ", lost" if state == LOST else ""
            say(f"node {name}: {done} done, {bad} failed, {work_s:.1f} s of work{gone}")

    def list_nodes(self) -> Lines:
        """Return name, state, tasks done and failed, and seconds of work of each node."""
        with self._lock:
            with suppress(RayError, ConnectionError):
                for node in ray.nodes():
                    name, told = node["NodeID"], node["NodeManagerHostname"]
                    if node["Alive"] or name in self._known:  # others were lost before this run
                        self._known[name] = told, HERE if node["Alive"] else LOST
            rows = [
                (f"{name} ({node[:6]})", state, *self._by_node.get(node, (0, 0, 0.0)))
                for node, (name, state) in self._known.items()
            ]
        return [HEAD, *rows]

    def submit(self, job: str, *, exclusive: bool) -> Future[JobResult]:
        """Return the future of a job's result; see `ProcessPool.submit`."""
        return self._threads.submit(self._run_job, job, exclusive)

    def _refuse_other_versions(self) -> None:
        here = [node["NodeID"] for node in ray.nodes() if node["Alive"]]
        tasks = (_build_task(node, exclusive=False, cores=0) for node in here)
        for answer in ray.get([task.remote("", __version__, "", False) for task in tasks]):
            if has_failed(answer):
                ray.shutdown()
                raise ClusterError(answer["error"])

    def _run_job(self, job: str, exclusive: bool) -> JobResult:
        """Run a job until it is done, or no other try can help."""
        node, tries, until_s = "", 1, 0.0
        while True:
            answer = self._run_once(job, node, exclusive=exclusive)
            until_s = until_s or time.monotonic() + OUTPUT_WAIT_S
            retry, own = answer.get("retry"), answer.pop("node", "")
            if retry == "later" and time.monotonic() < until_s and not self._over.wait(0.5):
                continue
            if retry == "elsewhere" and tries < MAX_NODES_TRIED:
                node, tries = _find_other_node(own), tries + 1
                if node:
                    continue
            seconds, bad = answer.pop("seconds", 0.0), int(has_failed(answer))
            with self._lock:
                done, worse, work_s = self._by_node.get(own, (0, 0, 0.0))
                self._by_node[own] = (done + 1 - bad, worse + bad, work_s + seconds)
            return answer

    def _run_once(self, job: str, node: str, *, exclusive: bool) -> JobResult:
        """Run a job on one node. Ray repeats it if that node dies."""
        try:
            with self._lock:
                if self._over.is_set():
                    raise RuntimeError("no task begins any more")
                task = _build_task(node, exclusive=exclusive)
                ref = task.remote(job, __version__, str(Path.cwd()), exclusive)
                self._running.add(ref)
            answer: JobResult = ray.get(ref)
            self._running.discard(ref)
            return answer
        except (RayError, ConnectionError) as e:
            lost = "the cluster is lost" if isinstance(e, ConnectionError) else LOST_TASK
            return {"error": f"{lost} ({type(e).__name__}: {str(e).strip().partition(chr(10))[0]})"}


def _build_task(node: str, *, exclusive: bool, cores: float = 1) -> Any:
    """Build the remote task, with a preferred node; an exclusive one takes all its cores."""
    if exclusive:
        alive = [n for n in ray.nodes() if n["Alive"]]
        cores = max(n["Resources"].get("CPU", 1) for n in alive)
    made = ray.remote(num_cpus=cores, max_retries=MAX_RESTARTS)(_run_on_node)
    if not node:
        return made
    return made.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=True))


def _find_other_node(node: str) -> str:
    """Return the id of another living node; empty: there is none."""
    return next((n["NodeID"] for n in ray.nodes() if n["Alive"] and n["NodeID"] != node), "")


def _cancel_tasks(running: list[Any]) -> None:
    """Cancel tasks: in order first, by force after a timeout."""
    for ref in running:
        ray.cancel(ref)
    _, left = ray.wait(running, num_returns=len(running), timeout=TERMINATE_TIMEOUT_S)
    for ref in left:
        ray.cancel(ref, force=True)


def _connect(address: str) -> None:
    """Connect to a cluster, and restore the signal handlers that Ray replaces.

    Raises
    ------
    ClusterError
        If the connection fails.
    """
    before = {number: signal.getsignal(number) for number in SIGNALS}
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address:
            _require_answer(address)
            ray.init(_to_ray_address(address), **quiet)
        else:
            _connect_here(quiet)
    except (ConnectionError, RuntimeError, ValueError, OSError, RayError) as e:
        why = " ".join(str(e).split())[:160]
        raise ClusterError(
            f"no Ray cluster answers at {address or 'this machine'} ({why}). "
            "Start one: ray start --head"
        ) from None
    finally:
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)


def _connect_here(quiet: dict[str, Any]) -> None:
    # A running cluster is noted in the system's temporary folder; our own ends with the command.
    os.environ["RAY_TMPDIR"] = str(find_system_folder())
    try:
        ray.init(os.environ.get("RAY_ADDRESS", "auto"), **quiet)
    except ConnectionError:
        os.environ.pop("RAY_TMPDIR")
        if "RAY_ADDRESS" in os.environ:
            raise
        # Ray advertises the machine's own address unless clusters are disabled.
        os.environ[ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR] = "0"
        ray_constants.ENABLE_RAY_CLUSTER = False
        ray.init("local", include_dashboard=False, _node_ip_address="127.0.0.1", **quiet)


def _require_answer(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        raise ClusterError(f"--on ray://{address} is not ray://HOST:PORT. Give both")
    with socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT_S):
        pass


def _to_ray_address(address: str) -> str:
    """Return the address for Ray: unchanged for a head, with a scheme for a client server."""
    known = {os.environ.get("RAY_ADDRESS"), *services.find_gcs_addresses()}
    if address in known:
        return address
    return f"ray://{address}"
