"""Two local Ray nodes give the same bytes as one process, even if a node dies.

Ray stays on the loopback interface and has no dashboard.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dmrl.errors import ClusterError, DmrlError, SettingError
from dmrl.pipeline.batch import run_over_folder
from dmrl.pipeline.executor import open_executor
from dmrl.pipeline.job import build_job
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.stages import dataset, fly, trim

from ..test_batch import read_files, write_recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),  # seconds, enough for a busy machine
    pytest.mark.filterwarnings("ignore"),  # warnings from Ray
]
SETTINGS = {
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # otherwise Ray uses the machine's external address
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_enable_metrics_collection": "0",
}
os.environ.update(SETTINGS)  # Ray reads them on import
NODE = {"num_cpus": 1, "object_store_memory": 80_000_000, "node_ip_address": "127.0.0.1"}
NODE |= {"include_dashboard": False, "include_log_monitor": False, "no_monitor": True}
TRIM_SETTINGS = trim.Settings(to_s=1.5)
COUNT = 40


class Nodes:
    """A head node, and another node that tests can kill."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster  # noqa: PLC0415 - reads the environment

        self.cluster = Cluster(initialize_head=True, head_node_args=dict(NODE))
        self.other: Any = self.cluster.add_node(**NODE)

    def kill_node(self) -> None:
        """Kill the other node."""
        self.cluster.remove_node(self.other, allow_graceful=False)
        self.other = None

    def restore_node(self) -> None:
        """Start the other node again if it was killed."""
        if self.other is None:
            self.other = self.cluster.add_node(**NODE)


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    """Start two nodes and set RAY_ADDRESS."""
    with pytest.MonkeyPatch.context() as patch:
        found = Nodes()
        patch.setenv("RAY_ADDRESS", found.cluster.address)
        yield found
        found.cluster.shutdown()


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `COUNT` recordings of different lengths."""
    folder = tmp_path_factory.mktemp("cluster") / "flights"
    for k in range(COUNT):
        write_recording(folder / f"{k % 4}" / f"{k:02d}.mcap", messages=20 + k, roll_rad=k)
    return folder


@pytest.fixture(scope="module")
def local_outputs(flights: Path) -> dict[str, bytes]:
    """Trim the flights in one local process and return the bytes of the outputs."""
    out = flights.parent / "alone"
    run_over_folder("trim", flights, out, TRIM_SETTINGS, workers=1)
    return read_files(out)


def test_ray_outputs_equal_local_outputs_and_nodes_are_listed(
    nodes: Nodes, flights: Path, local_outputs: dict[str, bytes], tmp_path: Path, capfd: Any
) -> None:
    run_over_folder("trim", flights, tmp_path / "out", TRIM_SETTINGS, workers=None, on="ray")
    assert read_files(tmp_path / "out") == local_outputs
    told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("node ")]
    assert len(told) == 2 and all(" 0 failed" in line for line in told)
    (tmp_path / "out" / "0" / "00.mcap").unlink()
    run_over_folder("trim", flights, tmp_path / "out", TRIM_SETTINGS, workers=None, on="ray")
    assert read_files(tmp_path / "out") == local_outputs
    assert capfd.readouterr().out.count("was there") == COUNT - 1


def test_recordings_with_special_characters_in_their_names_are_processed(
    nodes: Nodes, tmp_path: Path
) -> None:
    nodes.restore_node()
    names = {
        "$(touch victim).mcap",
        "a'b\"c.mcap",
        "-rf.mcap",
        "n\nl.mcap",
        "\u2028;touch victim.mcap",
    }
    for k, name in enumerate(sorted(names)):
        write_recording(tmp_path / "it's $(touch victim)\n" / name, roll_rad=k)
    source, out = tmp_path / "it's $(touch victim)\n", tmp_path / "-out\n"
    run_over_folder("trim", source, out, TRIM_SETTINGS, workers=None, on="ray")
    assert {path.name for path in out.glob("*.mcap")} == names
    run_over_folder("trim", source, tmp_path / "here", TRIM_SETTINGS, workers=1)
    assert read_files(out) == read_files(tmp_path / "here")
    assert not list(tmp_path.rglob("victim")) and not Path("victim").exists()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_node_that_dies_at_any_moment_loses_nothing(
    seed: int, nodes: Nodes, flights: Path, local_outputs: dict[str, bytes], tmp_path: Path
) -> None:
    nodes.restore_node()
    out = tmp_path / "out"
    after = random.Random(seed).randrange(COUNT - 10)

    def kill() -> None:
        while len(list(out.rglob("*.mcap"))) <= after:
            time.sleep(0.01)
        nodes.kill_node()

    killer = threading.Thread(target=kill)
    killer.start()
    run_over_folder("trim", flights, out, TRIM_SETTINGS, workers=None, on="ray")
    killer.join()
    assert nodes.other is None
    assert read_files(out) == local_outputs


@pytest.fixture(scope="module")
def sensor_flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with 40 flights with sensors and images: 8, each trimmed to 5 lengths."""
    folder = tmp_path_factory.mktemp("flown")
    for seed in range(8):
        whole = folder / f"{seed}.mcap"
        how = {"duration_s": 7.5, "noise": "calibrated", "seed": seed}
        pictures = {"camera": True, "cameras_max": 1, "camera_rate_hz": 2.0}
        fly.run(whole, fly.Settings(**how, **pictures))  # type: ignore[arg-type]
        for cut in range(5):
            out = folder / "flights" / f"{seed}{cut}.mcap"
            out.parent.mkdir(exist_ok=True)
            trim.run(whole, out, trim.Settings(to_s=7.5 - 0.4 * cut))
    return folder / "flights"


@pytest.fixture(scope="module")
def local_labels(sensor_flights: Path) -> Path:
    """Label the flights in one local process and return the folder of the outputs."""
    run_over_folder("label", sensor_flights, sensor_flights.parent / "labelled", workers=1)
    return sensor_flights.parent / "labelled"


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_labels_equal_one_process_even_if_a_node_dies(
    seed: int, nodes: Nodes, sensor_flights: Path, local_labels: Path, tmp_path: Path
) -> None:
    nodes.restore_node()
    out = tmp_path / "out"
    killer = threading.Thread(target=_kill_after, args=(nodes, out, seed))
    killer.start()
    run_over_folder("label", sensor_flights, out, workers=None, on="ray")
    killer.join()
    assert nodes.other is None
    assert read_files(out) == read_files(local_labels) and len(read_files(out)) == COUNT


def _kill_after(nodes: Nodes, out: Path, seed: int) -> None:
    """Kill the other node once a random number of outputs exists."""
    after = random.Random(seed).randrange(COUNT - 10)
    while len(list(out.rglob("*.mcap"))) <= after:
        time.sleep(0.01)
    nodes.kill_node()


def test_ray_dataset_equals_local_dataset(nodes: Nodes, local_labels: Path, tmp_path: Path) -> None:
    nodes.restore_node()
    given, how = sorted(local_labels.glob("*.mcap")), dataset.Settings(keep_all=True)
    dataset.run(given, tmp_path / "here", how, workers=1)
    told = run_on_cluster("ray", "dataset", tmp_path / "there", {"recordings": given}, how)
    assert told is not None and sum(told["images"].values()) >= COUNT
    assert read_files(tmp_path / "there") == read_files(tmp_path / "here")
    assert run_on_cluster("ray", "dataset", tmp_path / "there", {"recordings": given}, how) is None


def test_node_table_counts_jobs_and_marks_lost_nodes(
    nodes: Nodes, flights: Path, tmp_path: Path, capfd: Any
) -> None:
    nodes.restore_node()
    with open_executor("ray", None) as crew:
        assert (
            crew.list_nodes()[0][0] == "node"
            and [row[1:4] for row in crew.list_nodes()[1:]] == [("there", 0, 0)] * 2
        )
        lines = [
            build_job("trim", tmp_path / f"{k}.mcap", {"recording": flights / "0" / "00.mcap"}, {})
            for k in range(6)
        ]
        for future in [crew.submit(line, exclusive=False) for line in lines]:
            assert "error" not in future.result()
        assert sum(int(str(row[2])) for row in crew.list_nodes()[1:]) == 6
        nodes.kill_node()
        until_s = time.monotonic() + 30
        while "lost" not in {row[1] for row in crew.list_nodes()} and time.monotonic() < until_s:
            time.sleep(0.2)
    told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("node ")]
    assert len(told) == 2 and sum(line.endswith(", lost") for line in told) == 1


def test_job_that_fails_on_one_node_is_retried_elsewhere(nodes: Nodes, tmp_path: Path) -> None:
    """After an error of one node, such as a full disk, another node tries the job."""
    nodes.restore_node()
    with open_executor("ray", None) as crew:
        run_once = crew._run_once  # type: ignore[attr-defined]
        seen: list[str] = []

        def run_and_fail_first(*given: Any, **named: Any) -> Any:
            seen.append(run_once(*given, **named)["node"])
            if len(seen) == 1:
                (tmp_path / "b.mcap").unlink()
                return {"error": "no space left", "retry": "elsewhere", "node": seen[0]}
            return {"result": 1, "node": seen[1]}

        crew._run_once = run_and_fail_first  # type: ignore[attr-defined]
        source = write_recording(tmp_path / "a.mcap")
        line = build_job(
            "trim", tmp_path / "b.mcap", {"recording": source}, {"to_s": 1.0}, keep=True
        )
        answer = crew.submit(line, exclusive=False).result()
    assert "error" not in answer
    assert len(seen) == 2 and seen[0] != seen[1]


def test_failing_recording_does_not_stop_the_others(
    nodes: Nodes, flights: Path, tmp_path: Path
) -> None:
    few = tmp_path / "few"
    shutil.copytree(flights / "0", few)
    (few / "torn.mcap").write_bytes(b"no recording")
    with pytest.raises(DmrlError, match="1 of 11 recordings failed"):
        run_over_folder("trim", few, tmp_path / "out", TRIM_SETTINGS, workers=None, on="ray")
    assert len(read_files(tmp_path / "out")) == 10


def test_other_versions_and_wrong_addresses_give_one_line_errors(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmrl.pipeline.cluster.ray_executor.__version__", "9.9.9")
    with pytest.raises(ClusterError, match=r"has dmrl \S+, not 9\.9\.9\. Install the same"):
        open_executor("ray", None)
    monkeypatch.undo()
    with pytest.raises(ClusterError, match=r"no Ray cluster answers at 127\.0\.0\.1:1 "):
        open_executor("ray://127.0.0.1:1", None)


def test_ctrl_c_ends_the_tasks(nodes: Nodes, flights: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["trim", str(flights), str(out), "--to-s", "1.5", "--on", "ray"]
    code = f"from dmrl.cli import main; import sys; sys.argv = ['dmrl', *{words}]; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | SETTINGS,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not list(out.rglob("*.mcap")) and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=120)
    assert process.returncode == 130 and "stopped." in output
    made = read_files(out)
    time.sleep(2.0)
    assert read_files(out) == made
    assert not [name for name in made if name.endswith(".partial")]


def test_invalid_executor_gives_one_line_error() -> None:
    for on in ("spark", "ray://", "raytrace://host:1"):
        with pytest.raises(SettingError, match="this takes ray"):
            open_executor(on, None)
    with pytest.raises(SettingError, match="Leave out --workers"):
        open_executor("ray", 2)
    with pytest.raises(ClusterError, match=r"is not ray://HOST:PORT"):
        open_executor("ray://nowhere", None)
