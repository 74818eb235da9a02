"""Several processes that write one output, and recording of a flight under faults."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dmrl.atomic_output import to_partial_path
from dmrl.recording import check, read_summary, read_table, recover
from dmrl.simulation.drone_fleet import Fleet
from dmrl.simulation.drone_fleet import fleet as fly_fleet
from dmrl.stages import fake_drone, fly

from .conftest import Count, scale_cases
from .disk import REFUSALS, Disk, Fault
from .ending import run_to_end
from .fault_trials import FaultTrials
from .workloads import RECORD, WORKLOADS, Workload, clear_folder, find_workload

WRITERS = 6
KILLS = 50
SOAK_S = 180.0
AWAY = ("cf1=30:45", "cf2=60:90", "cf3=120:121")
"""Robot, and the times of the flight, s, between which it is switched off."""


def race_writers(work: Workload, disk: Disk, folder: Path, count: Count) -> None:
    """Let six processes write one output; assert that one succeeds and the others refuse.

    Later ones may succeed too if an output may be written again, as a card, or is found to be
    done, as the steps of a pipeline.
    """
    trials = FaultTrials(work, disk, folder, disk.inputs)
    trials.clear()
    given = {"work": work.name, "out": str(trials.out), "times": WRITERS}
    endings = disk.call("server:run_together", **given)
    refused = sum(status == 1 for status, _ in endings)
    assert all(status == 0 or (status == 1 and said) for status, said in endings), endings
    again = work.pieces or work.of == "report"
    assert refused == WRITERS - 1 or (again and refused < WRITERS), endings
    assert trials.done, endings
    assert [path.name for path in folder.iterdir()] == [work.out], endings
    count("six writers of one output", cases=WRITERS, refused=refused, right=WRITERS - refused)


@pytest.mark.heavy
def test_one_of_six_concurrent_writers_succeeds(disk: Disk, tmp_path: Path, count: Count) -> None:
    race_writers(find_workload("trim"), disk, tmp_path / "disk", count)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("work", WORKLOADS, ids=lambda work: work.name)
def test_one_of_six_concurrent_writers_of_each_command_succeeds(
    work: Workload, disk: Disk, tmp_path: Path, count: Count
) -> None:
    race_writers(work, disk, tmp_path / "disk", count)


def recover_partial(folder: Path) -> bool:
    """Recover a partial recording and check the result; return whether it had messages."""
    out = folder / RECORD.out
    assert not out.exists()
    if not to_partial_path(out).exists():
        return False
    mended = folder / "mended.mcap"
    status, output = run_to_end(lambda: recover(to_partial_path(out), mended))
    if status:
        assert "nothing to recover" in output or "no recording" in output, output
        return False
    assert not [f for f in check(mended) if f.level == "error"]
    return True


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_recording_survives_disk_faults(disk: Disk, tmp_path: Path, count: Count) -> None:
    """If the n-th operation of `record` fails, what was written before can be recovered."""
    pytest.importorskip("cflib", reason="cflib (extra record) is not installed")
    clear_folder(folder := tmp_path / "disk")
    for _ in range(2):  # the first run also makes the flight, an input
        clear_folder(folder)
        sound = disk.run("record", folder, RECORD.out)
    assert sound.status == 0
    cases = refused = again = 0
    for k in range(sound.operations):
        error = REFUSALS[k % len(REFUSALS)]
        clear_folder(folder)
        ending = disk.run("record", folder, RECORD.out, Fault(k, error, error == errno.ENOSPC))
        assert ending.status in (0, 1), ending
        if ending.status == 0:
            assert not [f for f in check(folder / RECORD.out) if f.level == "error"]
        else:
            again += recover_partial(folder)
        cases, refused = cases + 1, refused + ending.status
    assert again
    count(
        "the n-th operation fails: record",
        cases=cases,
        refused=refused,
        right=cases - refused,
        found=again,
    )


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_killed_recorders_keep_all_but_the_last_second(
    disk: Disk, tmp_path: Path, count: Count
) -> None:
    pytest.importorskip("cflib", reason="cflib (extra record) is not installed")
    clear_folder(folder := tmp_path / "disk")
    sound = disk.run("record", folder, RECORD.out)
    rng = np.random.default_rng(0)
    again = right = 0
    kills = scale_cases(KILLS)
    for _ in range(kills):
        clear_folder(folder)
        ending = disk.run("record", folder, RECORD.out, kill_s=float(rng.random()) * sound.seconds)
        killed_ns = time.time_ns()
        if ending.status == 0:
            right += 1
        elif recover_partial(folder):
            again += 1
            times = read_table(folder / "mended.mcap", "/cf1/attitude", fields=[])
            # The recorder flushes every second; the limit allows for a busy machine.
            assert killed_ns - times["publish_time"].to_numpy().max() < 5e9
    # With few kills, all may come before the first byte.
    assert again or kills < 10
    count("kill -9: record", cases=kills, right=right, found=again)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate a flight of three robots for `SOAK_S`."""
    path = tmp_path_factory.mktemp("flight") / "sim.mcap"
    fly.run(path, fly.Settings(3, SOAK_S, seed=3))
    return path


def start_recorder(out: Path, fleet: Fleet) -> subprocess.Popen[bytes]:
    """Start `dmrl record` for all drones of a fleet."""
    named = [f"--robot={d.robot}=udp://127.0.0.1:{d.port}" for d in fleet.drones]
    command = [sys.executable, "-m", "dmrl.cli", "record", str(out), *named, "--json"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ | {"TERM": "dumb"})


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_long_recording_loses_only_disconnected_packets(
    flight: Path, tmp_path: Path, count: Count
) -> None:
    """Three drones are switched off and on for three minutes, and drop 1 % of their packets."""
    pytest.importorskip("cflib", reason="cflib (extra record) is not installed")
    out = tmp_path / "out.mcap"
    uris = ("udp://127.0.0.1:0",) * 3
    settings = fake_drone.Settings(drop=0.01, dies=AWAY)
    with fly_fleet(flight, uris, (), settings) as fleet:
        with start_recorder(out, fleet) as process:
            while not fleet.clock.landed and process.poll() is None:
                time.sleep(0.2)
            time.sleep(1.0)
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate()
        sent = sum(drone.sent for drone in fleet.drones)
    assert process.returncode in (0, 130)
    assert not [f for f in check(out) if f.level == "error"]
    told = json.loads(output)
    received = sum(link["received"] for link in told["links"])
    assert all(link["connections"] > 1 for link in told["links"]), told["links"]
    assert received >= 0.99 * sent
    assert sum(told["messages"].values()) == read_summary(out).count
    count("soak of record: packets sent, received", cases=sent, right=received)
