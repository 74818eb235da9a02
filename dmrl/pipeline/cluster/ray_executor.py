"""Tasks on a Ray cluster: the same lines in the same processes, on whichever node is free.

Ray says where a task runs, and runs it again if its node dies. On the node it is given to a
process like those of `crew`, with the same environment: so the bytes are the same. Nodes have to
see the files by the same names, and to have the same version of dmrl.
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
from dmrl.pipeline.job import Answer, failed
from dmrl.terminal.progress import Lines, say

try:
    import ray
    from ray._private import ray_constants, services
    from ray.exceptions import RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as e:
    raise MissingExtra("ray", "cluster", "dmrl --on ray") from e

MOST_DEATHS = 5
"""How often a task is begun again because its node or its process there died."""
MOST_TRIES = 3
"""How often one is tried on another node, after an error of the node's: a full disk."""
BUSY_S = 60.0
"""How long a task waits for an output that one before it may still be writing."""
AHEAD = 4
"""Tasks for each core that Ray is told of at a time."""
ANSWER_S, LAST_WORDS_S, LOOK_S = 10.0, 30.0, 2.0
HEAD = ("node", "", "done", "failed", "s of work")
HERE, LOST = "there", "lost"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def _perform(line: str, version: str, folder: str, alone: bool) -> Answer:
    """On a node. Sent as it stands, so that it can say that dmrl is another there, or missing."""
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
    from dmrl.pipeline.cluster.ray_worker import perform  # noqa: PLC0415

    return {**perform(line, folder, alone=alone), "node": node}


_perform.__module__ = "__main__"  # so that it is sent by value


@dataclass(slots=True)
class _Given:
    """A task that Ray has been given, or will be.

    Parameters
    ----------
    line, alone
        As `Ray.give` takes them.
    future
        For who gave it.
    tries
        Nodes that it was tried on.
    until_s
        When an output that is being written is waited for no longer.
    not_before_s
        When it may be begun.
    node
        Id of the node that it is best done on; empty: any.
    """

    line: str
    alone: bool
    future: Future[Answer] = field(default_factory=Future)
    tries: int = 1
    until_s: float = 0.0
    not_before_s: float = 0.0
    node: str = ""


class Ray:
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

    alone_blocks = False

    def __init__(self, address: str = "") -> None:
        _connect(address)
        self._refuse_other_versions()
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._waiting: deque[_Given] = deque()
        self._running: dict[Any, _Given] = {}
        self._by_node: dict[str, tuple[int, int, float]] = {}
        self._known: dict[str, tuple[str, str]] = {}
        self._lock = threading.Lock()
        self._look()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
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
                _cancel(list(self._running))
            self._look()
        ray.shutdown()
        for name, state, done, bad, work_s in self.nodes()[1:]:
            gone = ", lost" if state == LOST else ""
            say(f"node {name}: {done} done, {bad} failed, {work_s:.1f} s of work{gone}")

    def nodes(self) -> Lines:
        """Each node: its name, whether it is there, tasks done and failed, seconds of work."""
        with self._lock:
            rows = [
                (f"{name} ({node[:6]})", state, *self._by_node.get(node, (0, 0, 0.0)))
                for node, (name, state) in self._known.items()
            ]
        return [HEAD, *rows]

    def _look(self) -> None:
        """See which nodes are there, and which are no more."""
        found = {
            node["NodeID"]: (node["NodeManagerHostname"], HERE if node["Alive"] else LOST)
            for node in ray.nodes()
        }
        with self._lock:
            # Of those that were lost before we came nobody needs to know.
            self._known = {
                node: told for node, told in found.items() if told[1] == HERE or node in self._known
            }

    def give(self, job: str, *, alone: bool) -> Future[Answer]:
        """The answer to a job, once it is there; see `Crew.give`."""
        given = _Given(job, alone)
        with self._lock:
            self._waiting.append(given)
        return given.future

    def _refuse_other_versions(self) -> None:
        here = [node["NodeID"] for node in ray.nodes() if node["Alive"]]
        looks = [
            _task(node, alone=False, cores=0).remote("", __version__, "", False) for node in here
        ]
        for answer in ray.get(looks):
            if failed(answer):
                ray.shutdown()
                raise ClusterError(answer["error"])

    def _watch(self) -> None:
        """Give Ray what waits, and hand on what it has done, until the end."""
        looked_s = time.monotonic()
        while not self._over.is_set():
            try:
                if time.monotonic() > looked_s + LOOK_S:
                    self._look()
                    looked_s = time.monotonic()
                self._begin()
                ready = self._ready()
            except (RayError, ConnectionError) as e:
                return self._lost(e)
            for ref in ready:
                self._hand_on(self._running.pop(ref), ref)
        return None

    def _begin(self) -> None:
        now_s = time.monotonic()
        with self._lock:
            for _ in range(len(self._waiting)):
                if len(self._running) >= AHEAD * self.workers:
                    return
                given = self._waiting.popleft()
                if given.not_before_s > now_s:
                    self._waiting.append(given)
                    continue
                task = _task(given.node, alone=given.alone)
                ref = task.remote(given.line, __version__, str(Path.cwd()), given.alone)
                self._running[ref] = given

    def _ready(self) -> list[Any]:
        if not self._running:
            time.sleep(0.02)
            return []
        found: list[Any] = ray.wait(list(self._running), timeout=0.1)[0]
        return found

    def _hand_on(self, given: _Given, ref: Any) -> None:
        try:
            answer: Answer = ray.get(ref)
        except RayError as e:
            why = str(e).strip().splitlines()[0]
            answer = {"error": f"it was lost {MOST_DEATHS + 1} times ({type(e).__name__}: {why})"}
        if self._again(given, answer):
            return
        if node := answer.pop("node", ""):
            seconds, bad = answer.pop("seconds", 0.0), int(failed(answer))
            with self._lock:
                done, worse, work_s = self._by_node.get(node, (0, 0, 0.0))
                self._by_node[node] = (done + 1 - bad, worse + bad, work_s + seconds)
        given.future.set_result(answer)

    def _again(self, given: _Given, answer: Answer) -> bool:
        """Whether a task is tried once more: it waits for another, or its node was at fault."""
        now_s = time.monotonic()
        given.until_s = given.until_s or now_s + BUSY_S
        match answer.get("again"):
            case "later" if now_s < given.until_s:
                given.not_before_s = now_s + 0.5
            case "elsewhere" if given.tries < MOST_TRIES and (node := _other(answer["node"])):
                given.tries, given.node = given.tries + 1, node
            case _:
                return False
        with self._lock:
            self._waiting.append(given)
        return True

    def _lost(self, error: Exception) -> None:
        """The cluster is gone: so are all answers."""
        why = (str(error).strip().splitlines() or [""])[0]
        with self._lock:
            given = [*self._running.values(), *self._waiting]
            self._running.clear()
            self._waiting.clear()
        for one in given:
            one.future.set_result({"error": f"the cluster is lost ({type(error).__name__}: {why})"})


def _task(node: str, *, alone: bool, cores: float = 1) -> Any:
    """The function as a task, best on a node; one that is alone takes all cores of one."""
    if alone:
        alive = [n for n in ray.nodes() if n["Alive"]]
        cores = max(n["Resources"].get("CPU", 1) for n in alive)
    made = ray.remote(num_cpus=cores, max_retries=MOST_DEATHS)(_perform)
    if not node:
        return made
    return made.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=True))


def _other(node: str) -> str:
    """Id of another living node; empty: there is none."""
    return next((n["NodeID"] for n in ray.nodes() if n["Alive"] and n["NodeID"] != node), "")


def _cancel(running: list[Any]) -> None:
    """End tasks: in order first, by force where that takes long."""
    for ref in running:
        ray.cancel(ref)
    _, left = ray.wait(running, num_returns=len(running), timeout=LAST_WORDS_S)
    for ref in left:
        ray.cancel(ref, force=True)


def _connect(address: str) -> None:
    """Connect to a cluster; what Ray does to signals is undone.

    Raises
    ------
    ClusterError
        If that cannot be done.
    """
    before = {number: signal.getsignal(number) for number in SIGNALS}
    quiet: dict[str, Any] = {
        "log_to_driver": False,
        "logging_level": "ERROR",
        "configure_logging": True,
    }
    try:
        if address:
            _require_answer(address)
            ray.init(_kind(address), **quiet)
        else:
            _of_this_machine(quiet)
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


def _of_this_machine(quiet: dict[str, Any]) -> None:
    try:
        ray.init(os.environ.get("RAY_ADDRESS", "auto"), **quiet)
    except ConnectionError:
        if "RAY_ADDRESS" in os.environ:
            raise
        # Ray advertises the machine's own address unless it is told that it is alone.
        os.environ[ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR] = "0"
        ray_constants.ENABLE_RAY_CLUSTER = False
        ray.init("local", include_dashboard=False, _node_ip_address="127.0.0.1", **quiet)


def _require_answer(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        raise ClusterError(f"--on ray://{address} is not ray://HOST:PORT. Give both")
    with socket.create_connection((host.strip("[]"), int(port)), ANSWER_S):
        pass


def _kind(address: str) -> str:
    """The address as Ray wants it: of a head as it is, of a client server with its scheme."""
    known = {os.environ.get("RAY_ADDRESS"), *services.find_gcs_addresses()}
    if address in known:
        return address
    return f"ray://{address}"
