"""Test how well offline figures of a network predict how long it keeps a leader in view.

    python benchmarks/bench_ranking.py FOLDER NETWORK... [--places 16] [--first 0] [--each]

Every network flies `fly_follow` with Blender's images in every place; the number of the place is
also the seed. An ideal detector flies in the same places with another seed, so along another path.
Each network then processes the images of those flights. The figures that `dmrl evaluate` computes
there are compared with the seconds that the network held its leader in its own flights. Prints
Spearman's correlation over all pairs of place and network, and the mean over places of the
correlation between networks. Recordings in FOLDER are reused.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

import dmrl
from dmrl import recipe as recipes
from dmrl.estimation.tracking.flight_metrics import compute_flight_figures
from dmrl.evaluation.flights import judge
from dmrl.geometry.frames import Array
from dmrl.simulation.flight_recording import FlySettings, record_flight
from dmrl.terminal.tables import print_table

OTHER_SEED = 1000
"""Added to the number of a place to get the seed of the ideal detector's flight."""
FIGURES = ("loop_s", "recall", "false_per_image", "longest_silence_s")


def fly(out: Path, place: int, seed: int, eye: Path) -> Path:
    """Fly in a place, unless the recording exists; return its path."""
    recipe = recipes.load("fly_follow", "fly", FlySettings)
    if not out.exists():
        record_flight(out, replace(recipe, eye=eye, seed=seed, place=place))
    return out


def measure(recording: Path) -> dict[str, float]:
    """Return the flight figures of a follower and its leader."""
    figures = compute_flight_figures(judge(recording)[0])
    return {name: np.nan if value is None else value for name, value in figures.items()}


def compare(folder: Path, network: Path, place: int) -> dict[str, float]:
    """Return the seconds held in a network's own flight, and its figures on the ideal flight."""
    name = f"{network.stem}-{network.parent.name}" if network.exists() else network.name
    flown = measure(fly(folder / f"{name}-{place}.mcap", place, place, network))
    other = fly(folder / f"ideal-{place}.mcap", place, OTHER_SEED + place, Path("ideal"))
    looked = folder / f"{name}-on-{place}.mcap"
    if not looked.exists():
        dmrl.predict(network, other, looked)
    seen = measure(looked)
    return {name: seen[name] for name in FIGURES} | {
        "held_s": flown["held_s"],
        "held": flown["held_to_end"] and not flown["contacts"],
    }


def rank(figure: Array, held_s: Array) -> tuple[float, float]:
    """Return the correlation over all pairs, and the mean over places of that between networks."""
    known = np.isfinite(figure)
    each = [
        spearmanr(*pair).statistic
        for pair in zip(figure.T, held_s.T, strict=True)
        if np.ptp(pair[0]) > 0 and np.ptp(pair[1]) > 0
    ]
    return float(spearmanr(figure[known], held_s[known]).statistic), float(np.mean(each))


def main() -> None:
    """Fly, predict, and print the correlations."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("networks", type=Path, nargs="+")
    parser.add_argument("--places", type=int, default=16)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--each", action="store_true", help="print every pair")
    given = parser.parse_args()
    places = range(given.first, given.first + given.places)
    found = [[compare(given.folder, one, place) for place in places] for one in given.networks]
    values = {name: np.array([[p[name] for p in row] for row in found]) for name in found[0][0]}
    held_s = values["held_s"]
    if given.each:
        rows = [
            [str(one), str(place), *(f"{value:.2f}" for value in pair.values())]
            for one, row in zip(given.networks, found, strict=True)
            for place, pair in zip(places, row, strict=True)
        ]
        print_table("", ["network", "place", *found[0][0]], rows)
    rows = [
        [str(one), f"{values['held'][k].sum():.0f}", f"{held_s[k].mean():.1f}"]
        for k, one in enumerate(given.networks)
    ]
    print_table("", ["network", "flights held", "mean held, s"], rows)
    rows = [[name, *(f"{v:.2f}" for v in rank(values[name], held_s))] for name in FIGURES]
    print_table("", ["figure", "all pairs", "within a place"], rows)


if __name__ == "__main__":
    main()
