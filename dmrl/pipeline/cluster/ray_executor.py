"""Executor that runs tasks on the nodes of a Ray cluster.

Ray chooses a node, which runs the task in a process like those of `process_pool`, so the bytes are
the same. Nodes need access to the files by the same names, and the same version of dmrl.
"""

import os
import signal
import socket
import threading
import time
from collections import deque
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dmrl import __version__
from dmrl.errors import ClusterError, MissingExtra
from dmrl.guards.temporary_folder import find_system_folder
from dmrl.pipeline.job import JobResult, has_failed
from dmrl.terminal.progress import Lines, say
from dmrl.terminal.signals import TERMINATION_SIGNALS as SIGNALS

try:
    import ray
    from ray._private import ray_constants, services
    from ray.exceptions import RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as e:
    raise MissingExtra("ray", "cluster", "dmrl --on ray") from e

MAX_RESTARTS = 5
"""Most restarts of a task whose node or process died."""
MAX_NODES_TRIED = 3
"""Most nodes that a task is tried on, after an error of a node such as a full disk."""
OUTPUT_WAIT_S = 60.0
"""Longest wait, seconds, for an output that another task may still be writing."""
TASKS_AHEAD_PER_CORE = 4
"""Tasks per core that Ray is given at a time."""
CONNECT_TIMEOUT_S, TERMINATE_TIMEOUT_S, NODE_POLL_S = 10.0, 30.0, 2.0
HEAD = ("node", "", "done", "failed", "s of work")
HERE, LOST = "there", "lost"


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


@dataclass(slots=True)
class _RayTask:
    """A task that waits for Ray, or runs there.

    Parameters
    ----------
    line, exclusive
        As `RayExecutor.submit` takes them.
    future
        Future of the result.
    tries
        Number of nodes that were tried.
    until_s
        End of the wait for an output that is being written.
    not_before_s
        Earliest start.
    node
        Id of the preferred node; empty: any.
    """

    line: str
    exclusive: bool
    future: Future[JobResult] = field(default_factory=Future)
    tries: int = 1
    until_s: float = 0.0
    not_before_s: float = 0.0
    node: str = ""


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
        self._waiting: deque[_RayTask] = deque()
        self._running: dict[Any, _RayTask] = {}
        self._by_node: dict[str, tuple[int, int, float]] = {}
        self._known: dict[str, tuple[str, str]] = {}
        self._lock = threading.Lock()
        self._update_nodes()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run_loop, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()
        with suppress(RayError, ConnectionError):
            if self._running:
                _cancel_tasks(list(self._running))
            self._update_nodes()
        ray.shutdown()
        for name, state, done, bad, work_s in self.list_nodes()[1:]:
            gone = ", lost" if state == LOST else ""
            say(f"node {name}: {done} done, {bad} failed, {work_s:.1f} s of work{gone}")

    def list_nodes(self) -> Lines:
        """Return name, state, tasks done and failed, and seconds of work of each node."""
        with self._lock:
            rows = [
                (f"{name} ({node[:6]})", state, *self._by_node.get(node, (0, 0, 0.0)))
                for node, (name, state) in self._known.items()
            ]
        return [HEAD, *rows]

    def _update_nodes(self) -> None:
        """Update the list of living and lost nodes."""
        found = {
            node["NodeID"]: (node["NodeManagerHostname"], HERE if node["Alive"] else LOST)
            for node in ray.nodes()
        }
        with self._lock:
            # Nodes that were lost before this run are left out.
            self._known = {
                node: told for node, told in found.items() if told[1] == HERE or node in self._known
            }

    def submit(self, job: str, *, exclusive: bool) -> Future[JobResult]:
        """Return the future of a job's result; see `ProcessPool.submit`."""
        given = _RayTask(job, exclusive)
        with self._lock:
            self._waiting.append(given)
        return given.future

    def _refuse_other_versions(self) -> None:
        here = [node["NodeID"] for node in ray.nodes() if node["Alive"]]
        tasks = (_build_task(node, exclusive=False, cores=0) for node in here)
        for answer in ray.get([task.remote("", __version__, "", False) for task in tasks]):
            if has_failed(answer):
                ray.shutdown()
                raise ClusterError(answer["error"])

    def _run_loop(self) -> None:
        """Start waiting tasks and deliver results, until the end."""
        looked_s = time.monotonic()
        while not self._over.is_set():
            try:
                if time.monotonic() > looked_s + NODE_POLL_S:
                    self._update_nodes()
                    looked_s = time.monotonic()
                self._start_waiting()
                ready = self._wait_for_results()
            except (RayError, ConnectionError) as e:
                return self._fail_all(e)
            for ref in ready:
                self._deliver(self._running.pop(ref), ref)
        return None

    def _start_waiting(self) -> None:
        now_s = time.monotonic()
        with self._lock:
            for _ in range(len(self._waiting)):
                if len(self._running) >= TASKS_AHEAD_PER_CORE * self.workers:
                    return
                given = self._waiting.popleft()
                if given.not_before_s > now_s:
                    self._waiting.append(given)
                    continue
                task = _build_task(given.node, exclusive=given.exclusive)
                ref = task.remote(given.line, __version__, str(Path.cwd()), given.exclusive)
                self._running[ref] = given

    def _wait_for_results(self) -> list[Any]:
        if not self._running:
            time.sleep(0.02)
            return []
        found: list[Any] = ray.wait(list(self._running), timeout=0.1)[0]
        return found

    def _deliver(self, given: _RayTask, ref: Any) -> None:
        try:
            answer: JobResult = ray.get(ref)
        except RayError as e:
            why = str(e).strip().splitlines()[0]
            answer = {"error": f"it was lost {MAX_RESTARTS + 1} times ({type(e).__name__}: {why})"}
        if self._retry(given, answer):
            return
        if node := answer.pop("node", ""):
            seconds, bad = answer.pop("seconds", 0.0), int(has_failed(answer))
            with self._lock:
                done, worse, work_s = self._by_node.get(node, (0, 0, 0.0))
                self._by_node[node] = (done + 1 - bad, worse + bad, work_s + seconds)
        given.future.set_result(answer)

    def _retry(self, given: _RayTask, answer: JobResult) -> bool:
        """Return whether a task is tried again: an output was busy, or its node failed."""
        now_s = time.monotonic()
        given.until_s = given.until_s or now_s + OUTPUT_WAIT_S
        match answer.get("retry"):
            case "later" if now_s < given.until_s:
                given.not_before_s = now_s + 0.5
            case "elsewhere" if given.tries < MAX_NODES_TRIED and (
                node := _find_other_node(answer["node"])
            ):
                given.tries, given.node = given.tries + 1, node
            case _:
                return False
        with self._lock:
            self._waiting.append(given)
        return True

    def _fail_all(self, error: Exception) -> None:
        """Fail all tasks: the cluster is lost."""
        why = (str(error).strip().splitlines() or [""])[0]
        with self._lock:
            given = [*self._running.values(), *self._waiting]
            self._running.clear()
            self._waiting.clear()
        for one in given:
            one.future.set_result({"error": f"the cluster is lost ({type(error).__name__}: {why})"})


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
