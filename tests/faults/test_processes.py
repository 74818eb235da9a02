"""Several processes: writers of one output, and recorders of a flight that are killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dmrl.recording import check, read_table, recover, summary
from dmrl.stages import fake_drone, fly

from .conftest import Count, cases_of, ended
from .test_strangers import in_a_child
from .works import WORKS, Inputs, contents

# Python 3.12 says that threads of the parent are not in the child; it needs none of them.
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")

WRITERS = 6
SOAK_S = 60.0
PATIENCE_S = 60.0


def race(name: str, inputs: Inputs, folder: Path, count: Count) -> None:
    """Six processes write one output: one succeeds, the others say why not."""
    work = next(work for work in WORKS if work.name == name)
    alone = folder / f"first{Path(work.out).suffix}"
    ended(lambda: work.run(inputs, alone))
    whole = contents(alone)
    assert whole
    out = folder / work.out
    numbers = []
    for _ in range(WRITERS):
        number = os.fork()
        if number == 0:
            os._exit(in_a_child(lambda: work.run(inputs, out)))
        numbers.append(number)
    statuses = [os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]) for number in numbers]
    assert sorted(statuses) == [0] + [1] * (WRITERS - 1)
    assert contents(out) == whole
    assert sorted(path.name for path in folder.iterdir()) == sorted([alone.name, work.out])
    count("six writers of one output", cases=WRITERS, refused=WRITERS - 1, right=1)


@pytest.mark.parametrize("name", ["trim", "recover"])
def test_of_six_writers_one_succeeds(
    name: str, inputs: Inputs, tmp_path: Path, count: Count
) -> None:
    race(name, inputs, tmp_path, count)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["dataset", "predict", "convert to csv", "merge"])
def test_of_six_writers_of_larger_outputs_one_succeeds(
    name: str, inputs: Inputs, tmp_path: Path, count: Count
) -> None:
    race(name, inputs, tmp_path, count)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that fly for a minute."""
    path = tmp_path_factory.mktemp("flight") / "sim.mcap"
    fly.run(path, fly.Settings(duration_s=SOAK_S, seed=3))
    return path


def recorder(out: Path, fleet: fake_drone.Fleet) -> subprocess.Popen[bytes]:
    named = [f"--robot={d.robot}=udp://127.0.0.1:{d.port}" for d in fleet.drones]
    command = [sys.executable, "-m", "dmrl.cli", "record", str(out), *named]
    return subprocess.Popen(command, stderr=subprocess.PIPE)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_killed_recorders_keep_all_but_the_last_second(
    flight: Path, tmp_path: Path, count: Count
) -> None:
    pytest.importorskip("cflib", reason="cflib (extra record) is not installed")
    rng = np.random.default_rng(0)
    again = empty = 0
    kills = cases_of(50)
    for k in range(kills):
        out, mended = tmp_path / f"{k}.mcap", tmp_path / f"mended-{k}.mcap"
        uris = ("udp://127.0.0.1:0",) * 2
        with (
            fake_drone.fleet(flight, uris, (), fake_drone.Settings()) as fleet,
            recorder(out, fleet) as process,
        ):
            until = time.monotonic() + PATIENCE_S
            while not begun(partial(out)) and time.monotonic() < until:
                time.sleep(0.05)
            time.sleep(float(rng.uniform(0.0, 4.0)))
            process.send_signal(signal.SIGKILL)
            killed_ns = time.time_ns()
        assert not out.exists()
        status, said = ended(lambda out=out, mended=mended: recover(partial(out), mended))
        if status:
            assert "nothing to recover" in said or "no recording" in said
            empty += 1
            continue
        again += 1
        assert not [f for f in check(mended) if f.level == "error"]
        times = read_table(mended, "/cf1/attitude", fields=[])["publish_time"].to_numpy()
        assert killed_ns - times.max() < 5e9  # one second by design; the rest is a busy machine
    assert again
    count("kill -9: record", cases=kills, right=0, found=again)


def begun(unfinished: Path) -> bool:
    """Whether a recorder has begun to write."""
    return unfinished.exists() and unfinished.stat().st_size > 1000


def partial(out: Path) -> Path:
    return out.with_name(out.name + ".partial")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_soak_of_recording_loses_nothing(flight: Path, tmp_path: Path, count: Count) -> None:
    """A minute of two drones that send at full rate, recorded to the end."""
    pytest.importorskip("cflib", reason="cflib (extra record) is not installed")
    out = tmp_path / "out.mcap"
    uris = ("udp://127.0.0.1:0",) * 2
    with fake_drone.fleet(flight, uris, (), fake_drone.Settings()) as fleet:
        with recorder(out, fleet) as process:
            while not fleet.clock.landed and process.poll() is None:
                time.sleep(0.2)
            time.sleep(1.0)
            process.send_signal(signal.SIGINT)
            process.wait()
        sent = sum(drone.sent for drone in fleet.drones)
    assert process.returncode in (0, 130)
    found = summary(out)
    assert not [f for f in check(out) if f.level == "error"]
    seen = len(read_table(out, "/cf1/attitude", fields=[]))
    assert seen > 0.9 * 100 * (SOAK_S - 5)
    count("soak of record: packets sent, messages kept", cases=sent, right=found.count)
