"""Simulate the schedule of many tasks on many nodes, of which some are slow and some die.

    python benchmarks/sim_schedule.py [--tasks 10000] [--nodes 32] [--cores 16] [--seeds 5]

The rules are those of `dmrl --on ray`. The largest inputs start first, each core runs one task, and
a task of a dead node is restarted at most five times. One driver submits the tasks one by one. The
assumptions are options. The seconds per task come from `bench_items.py` (docs/scale.md), and the
cost of submitting one from `bench_cluster.py`. How often nodes are slow or die is assumed.
"""

import argparse
import heapq
from dataclasses import dataclass

import numpy as np

from dmrl.terminal.tables import print_table

MOST_DEATHS = 5


@dataclass(frozen=True, slots=True)
class World:
    """Assumptions of a simulation.

    Parameters
    ----------
    tasks, nodes, cores
        Number of tasks, of nodes, and of cores per node.
    task_s
        Mean CPU seconds of a task.
    spread
        Standard deviation of the task times over their mean; they are log-normal.
    overhead_s
        Seconds that the driver needs to submit a task; it submits one at a time.
    slow_share, slow_times
        Share of slow nodes, and the factor by which they take longer.
    node_life_h, away_h
        Mean hours until a node dies, and the hours until it returns. 0: no node dies.
    by_size
        Start the largest tasks first; else in random order.
    """

    tasks: int
    nodes: int
    cores: int
    task_s: float
    spread: float
    overhead_s: float
    slow_share: float = 0.0
    slow_times: float = 1.0
    node_life_h: float = 0.0
    away_h: float = 0.25
    by_size: bool = True


@dataclass(frozen=True, slots=True)
class Outcome:
    """Hours until the end, used share of the cores' time, restarts, and lost tasks."""

    hours: float
    used: float
    again: int
    lost: int


def simulate(world: World, seed: int) -> Outcome:
    """Simulate one schedule.

    Events are the ends of tasks and the deaths and returns of nodes, in order of time. A death ends
    the tasks of the node; they are restarted before all others.
    """
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(np.log1p(world.spread**2))
    work_s = world.task_s * np.exp(rng.normal(-(sigma**2) / 2, sigma, world.tasks))
    slow = rng.random(world.nodes) < world.slow_share
    pace = np.where(slow, world.slow_times, 1.0)
    waiting = list(np.argsort(work_s) if world.by_size else np.arange(world.tasks)[::-1])
    ended: list[tuple[float, int]] = []  # times of death, and tasks that they ended
    free = [(0.0, node) for node in range(world.nodes) for _ in range(world.cores)]
    deaths = [np.inf] * world.nodes
    if world.node_life_h:
        deaths = list(rng.exponential(3600 * world.node_life_h, world.nodes))
    heapq.heapify(free)
    begun, driver_s, end_s, again, lost = np.zeros(world.tasks, int), 0.0, 0.0, 0, 0
    while waiting or ended:
        now_s, node = heapq.heappop(free)
        while ended and ended[0][0] <= now_s:
            waiting.append(heapq.heappop(ended)[1])
        if not waiting:
            heapq.heappush(free, (ended[0][0], node))
            continue
        if now_s >= deaths[node]:  # the node is dead, and returns later
            back_s = deaths[node] + 3600 * world.away_h
            if now_s < back_s:
                heapq.heappush(free, (back_s, node))
                continue
            deaths[node] = back_s + rng.exponential(3600 * world.node_life_h)
        task = int(waiting.pop())
        driver_s = max(driver_s, now_s) + world.overhead_s
        done_s = driver_s + work_s[task] * pace[node]
        begun[task] += 1
        if done_s > deaths[node]:
            if begun[task] > MOST_DEATHS:
                lost += 1
            else:
                again += 1
                heapq.heappush(ended, (deaths[node], task))
            heapq.heappush(free, (deaths[node], node))
            continue
        end_s = max(end_s, done_s)
        heapq.heappush(free, (done_s, node))
    used = work_s.sum() / (end_s * world.nodes * world.cores)
    return Outcome(end_s / 3600, float(used), again, lost)


def main() -> None:
    """Print a row for each scenario: means over seeds, and the worst."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, value in (("tasks", 10_000), ("nodes", 32), ("cores", 16), ("seeds", 5)):
        parser.add_argument(f"--{name}", type=int, default=value)
    for name, value in (("task-s", 135.0), ("spread", 0.3), ("overhead-s", 0.02)):
        parser.add_argument(f"--{name}", type=float, default=value)
    given = parser.parse_args()
    calm = {
        name: getattr(given, name)
        for name in ("tasks", "nodes", "cores", "task_s", "spread", "overhead_s")
    }
    slow, dying = {"slow_share": 0.1, "slow_times": 3.0}, {"node_life_h": 12.0}
    kinds = {
        "no faults": {},
        "no faults, random order": {"by_size": False},
        "one node in ten takes 3 times as long": slow,
        "a node dies every 12 h, away 15 min": dying,
        "both": slow | dying,
        "both, random order": slow | dying | {"by_size": False},
        "both, a node dies every hour": slow | {"node_life_h": 1.0},
    }
    rows = []
    for name, more in kinds.items():
        found = [simulate(World(**calm, **more), seed) for seed in range(given.seeds)]
        hours = [one.hours for one in found]
        used = np.mean([one.used for one in found])
        again = np.mean([one.again for one in found])
        lost = sum(one.lost for one in found)
        rows.append((name, np.mean(hours), max(hours), f"{used:.1%}", again, lost))
    heads = ("scenario", "hours", "worst hours", "cores used", "restarts", "tasks lost in all runs")
    print_table(f"{given.tasks} tasks, {given.nodes} x {given.cores} cores", heads, rows)


if __name__ == "__main__":
    main()
