"""Where a pair may have started: many guesses on the range circle, told apart by likelihood."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from dmrl.estimation.filters import keyframe_ekf
from dmrl.estimation.filters.camera_update import NOTHING, Glances, repeated
from dmrl.estimation.filters.keyframe_ekf import Inputs
from dmrl.estimation.model.odometry import QUARTER_TURN
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.levenberg_marquardt import near

BEARINGS, HEADINGS = 12, 8
"""96 starts: bearings of the peer, each with headings of the peer."""
FIRST_S = 20.0
"""How long all starts are followed."""
KEPT = 6
"""Starts that are followed to the end."""
START_STD: Array = np.array([0.35, 0.35, 0.45, 0.01, 0.01])
"""Half the distance to the next start, roughly: m, m, rad; and of the yaw rates' biases, rad/s."""
APART_M, APART_RAD = 0.4, 0.5
"""Starts nearer than both are one."""
PASS_M = 0.35
"""Two passes nearer than this leave open on which side the peer was in between."""
MIRRORED = 4
"""Stretches between passes that are tried on the other side, the shortest."""
BESIDE_M, ROUND_M = 0.5, 0.4
"""A pass nearer than this may have been on the other side; it begins and ends so much farther."""
BESIDE = 6
"""So often this is tried, the nearest passes first."""
COST_UNIT = 4.0
"""Costs of solutions differ by this much for no good reason: the robust loss and the noise are
not quite the sensors'. A solution that costs this much more counts 1 / e of the better one."""


def starts(range_m: float, height_m: float) -> Array:
    """(96, 3) starts x, y (m), psi (rad) around an observer.

    Parameters
    ----------
    range_m
        First range, metres.
    height_m
        Peer's height less the observer's, metres.
    """
    radius = np.sqrt(max(range_m**2 - height_m**2, 0.05**2))
    bearing = np.repeat(np.arange(BEARINGS) * 2 * np.pi / BEARINGS, HEADINGS)
    heading = np.tile(np.arange(HEADINGS) * 2 * np.pi / HEADINGS, BEARINGS)
    # Neighbouring bearings get headings half a step apart, which fills the space better.
    heading = heading + np.repeat(np.arange(BEARINGS) % 2, HEADINGS) * np.pi / HEADINGS
    return np.column_stack([radius * np.cos(bearing), radius * np.sin(bearing), heading])


def candidates(inputs: Inputs, rate_hz: float, glances: Glances = NOTHING) -> Array:
    """(P, KEPT, 3) likely starts of P pairs, best first, distinct as far as there are such.

    Parameters
    ----------
    inputs
        Of P pairs.
    rate_hz
        Keyframes per second.
    glances
        What cameras saw, of each pair.
    """
    keyframes = min(len(inputs.range_m), int(FIRST_S * rate_hz))
    first = [_first(inputs, pair, keyframes) for pair in range(inputs.range_m.shape[1])]
    count = BEARINGS * HEADINGS
    given = inputs.repeated(count, keyframes), np.concatenate(first), START_STD
    run = keyframe_ekf.run(*given, repeated(glances, count))
    end = run.state[-1, :, :3].reshape(-1, count, 3)
    score = run.log_likelihood.reshape(-1, count)
    begun = np.stack(first)
    return np.stack(
        [b[distinct(e, np.argsort(-s), KEPT)] for b, e, s in zip(begun, end, score, strict=True)]
    )


def _first(inputs: Inputs, pair: int, keyframes: int) -> Array:
    ranges = inputs.range_m[:keyframes, pair]
    seen = np.flatnonzero(np.isfinite(ranges))
    # The median of the first second: a single first range may be an outlier.
    start = float(np.median(ranges[seen[:10]])) if len(seen) else 1.0
    return starts(start, float(inputs.height_m[seen[0], pair]) if len(seen) else 0.0)


def distinct(states: Array, order: NDArray[np.intp], count: int) -> list[int]:
    """Numbers of ``count`` states, in order, that differ; the last is repeated to fill up.

    Parameters
    ----------
    states
        (N, 3) x, y, psi.
    order
        (N,) their numbers, best first.
    count
        How many.
    """
    kept: list[int] = []
    for number in order.tolist():
        apart = [not alike(states[number], states[other]) for other in kept]
        if all(apart):
            kept.append(number)
        if len(kept) == count:
            break
    return kept + kept[-1:] * (count - len(kept))


def alike(one: Array, other: Array) -> bool:
    """Whether two states are the same solution."""
    turn = np.angle(np.exp(1j * (one[2] - other[2])))
    return bool(np.hypot(*(one - other)[:2]) < APART_M and abs(turn) < APART_RAD)


def spread_of(cost: Array, states: Array) -> Array:
    """(K, 3, 3) covariance that the choice between several solutions adds to the best one's.

    Parameters
    ----------
    cost
        (S,) of each, lowest first: half the sum of squares, or less the log likelihood.
    states
        (S, K, 3) x, y (m), psi (rad).
    """
    kept: list[int] = []
    for number, state in enumerate(states):
        if not any(near(state, states[other]) for other in kept):
            kept.append(number)
    share = np.exp((cost[0] - cost[kept]) / COST_UNIT)
    apart = states[kept] - states[0]
    apart[:, :, 2] = np.angle(np.exp(1j * apart[:, :, 2]))
    return np.asarray(np.einsum("s,ski,skj->kij", share / share.sum(), apart, apart))


def _passes(state: Array, rate_hz: float, within_m: float) -> tuple[Array, NDArray[np.intp]]:
    """(K,) distances of the peer, and the keyframes at which it is nearest and so near."""
    distance = np.hypot(*state[:, :2].T)
    least = minimum_filter1d(distance, 2 * round(rate_hz) + 1)
    return distance, np.flatnonzero((distance == least) & (distance < within_m))


def mirrored(state: Array, rate_hz: float) -> list[Array]:
    """Copies of a solution with the peer on the other side between two close passes.

    Parameters
    ----------
    state
        (K, 6) x, y (m), psi (rad), wx, wy (m/s), b (m).
    rate_hz
        Keyframes per second.
    """
    second, (_, passes) = round(rate_hz), _passes(state, rate_hz, PASS_M)
    between = sorted(pairwise(passes.tolist()), key=lambda ends: ends[1] - ends[0])
    out = []
    for start, end in between[:MIRRORED]:
        way = state[min(end + second // 2, len(state) - 1), :2] - state[end - second // 2, :2]
        aside = QUARTER_TURN @ way / max(float(np.hypot(*way)), 1e-6)
        copy = state.copy()
        # p - 2 (n p) n, a mirror along the way: ranges stay as they are, odometry does not.
        copy[start:end, :2] -= 2 * np.outer(copy[start:end, :2] @ aside, aside)
        out.append(copy)
    return out


def passed_by(state: Array, rate_hz: float) -> list[Array]:
    """Copies of a solution, each with the peer going past the observer on the other side once.

    Parameters
    ----------
    state
        (K, 6) x, y (m), psi (rad), wx, wy (m/s), b (m).
    rate_hz
        Keyframes per second.
    """
    distance, passes = _passes(state, rate_hz, BESIDE_M)
    out = []
    for at in passes[np.argsort(distance[passes])].tolist():
        farther = np.flatnonzero(distance > distance[at] + ROUND_M)
        start = int(farther[farther < at].max(initial=-1)) + 1
        end = int(farther[farther > at].min(initial=len(state)))
        way = state[min(at + 2, len(state) - 1), :2] - state[max(at - 2, 0), :2]
        aside = QUARTER_TURN @ way / max(float(np.hypot(*way)), 1e-6)
        # Wholly mirrored where it is nearest, less and less from there on: a way without a jump.
        near = np.cos((distance[start:end] - distance[at]) / ROUND_M * np.pi / 2)
        copy = state.copy()
        copy[start:end, :2] -= np.outer(2 * near * (copy[start:end, :2] @ aside), aside)
        out.append(copy)
    return out
