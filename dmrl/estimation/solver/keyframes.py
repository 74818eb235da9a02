"""Cut a flight of N robots into keyframes: the measured data of every factor."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.odometry import preintegrate
from dmrl.estimation.model.pair import (
    Array,
    BearingMeasurements,
    Mask,
    Pair,
    SensorTrack,
    longest_gap_s,
)
from dmrl.estimation.signals.jump_detection import step_offsets
from dmrl.estimation.solver.problem import (
    CORRELATION_S,
    CameraView,
    Measured,
    NoiseModel,
    Problem,
    RangeLink,
    Steps,
)
from dmrl.estimation.solver.unknowns import MEASURED_CLOCK, TABLE, with_rows

KEYFRAME_HZ = 5.0
"""Keyframes per second, Hz. Twice the rate costs twice the time and gave the same error on ten
simulated flights; ranges and outputs keep their own times."""
MAX_IMAGE_SHIFT_S = 0.025
"""Longest time between an image that is used and its keyframe, seconds. The noise of the odometry
between them is no error of the camera. Within 0.1 s it is 1 cm; taken for an error of the camera,
it moves the peer away, where a pixel spans more. Within 25 ms it is 2 mm."""
FIXED_KEYFRAMES = 50
"""Number of keyframes from one that keeps its time to the next. Windows begin there."""
RANGE_BLOCK_S, RANGE_MEDIAN_BLOCKS, MIN_RANGE_STEP_M = 0.1, 3, 0.45
"""Detection of range steps for the search: shortest length of a block, seconds; number of block
medians on either side; smallest step, metres. Smaller steps are left to the solve."""


def select_measurements(measured: Measured, chosen: Mask) -> Measured:
    """Return some of the ranges of a link, or of the images of a view."""
    names = [name for name in measured.__dataclass_fields__ if name != "robots"]
    return replace(measured, **{name: getattr(measured, name)[chosen] for name in names})


def build_problem(pairs: Mapping[tuple[int, int], Pair], rate_hz: float = KEYFRAME_HZ) -> Problem:
    """Cut a flight into keyframes over the time that all robots share.

    Parameters
    ----------
    pairs
        Sensor data by the indices of both robots, each pair once.
    rate_hz
        Keyframes per second.
    """
    start_s = max(pair.time_s[0] for pair in pairs.values())
    end_s = min(pair.time_s[-1] for pair in pairs.values())
    count = max(2, int((end_s - start_s) * rate_hz + 1e-6) + 1)
    key_s = np.minimum(start_s + np.arange(count) / rate_hz, end_s)
    key_s = _move_to_images(key_s, _list_image_times(pairs))
    logs: dict[int, tuple[Array, SensorTrack]] = {}
    for both, pair in pairs.items():
        for number, track in zip(both, (pair.own, pair.peer), strict=True):
            # A contradiction with one peer's ranges counts for all of them.
            if number not in logs or track.dropout.mean() > logs[number][1].dropout.mean():
                logs[number] = pair.time_s, track
    robots = [_cut_steps(*logs[number], key_s) for number in range(len(logs))]
    links, views = [], []
    for (one, other), pair in pairs.items():
        links.append(_cut_link((one, other), pair, robots, key_s))
        for side, sees in (((one, other), pair.own_bearings), ((other, one), pair.peer_bearings)):
            used = sees and _select_images(sees, key_s)
            if used is not None and len(used.time_s):
                views.append(_cut_view(side, used, pair, robots, key_s))
    known = _collect_known(pairs)
    for view in views:
        # Errors that last are as large as those of one detection.
        for axis, name in enumerate(("camera_azimuth", "camera_elevation", "camera_distance")):
            known[name, view.robots[:1]] = float(np.nanmedian(view.std[..., axis]))
    noise = NoiseModel(known_std=known)
    table = with_rows(TABLE, MEASURED_CLOCK) if ("clock", (1,)) in known else TABLE
    return Problem(key_s, tuple(robots), tuple(links), tuple(views), table, noise)


def _list_image_times(pairs: Mapping[tuple[int, int], Pair]) -> list[Array]:
    """Return the times of the images of each camera."""
    seen: dict[int, list[Array]] = {}
    for both, pair in pairs.items():
        for robot, sees in zip(both, (pair.own_bearings, pair.peer_bearings), strict=True):
            if sees is not None:
                seen.setdefault(robot, []).append(sees.time_s)
    return [np.unique(np.concatenate(times)) for times in seen.values()]


def _move_to_images(key_s: Array, cameras: Sequence[Array]) -> Array:
    """Return the times of the keyframes, moved to images by less than half of their distance.

    The cameras take turns, so that each has images at keyframes.

    Parameters
    ----------
    key_s
        (K,) times of the keyframes, seconds.
    cameras
        (I,) times of the images of each camera, seconds.
    """
    out, turns = key_s.copy(), [0] * len(cameras)
    half_s = float(np.diff(key_s[:2])[0]) / 2
    spans = [
        (np.searchsorted(seen, key_s - half_s), np.searchsorted(seen, key_s + half_s))
        for seen in cameras
    ]
    for k in range(1, len(key_s) - 1):
        if k % FIXED_KEYFRAMES == 0:
            continue
        for one in sorted(range(len(cameras)), key=turns.__getitem__):
            inside = cameras[one][spans[one][0][k] : spans[one][1][k]]
            inside = inside[inside > out[k - 1] + half_s / 2]
            if len(inside):
                out[k] = inside[np.abs(inside - key_s[k]).argmin()]
                turns[one] += 1
                break
    return out


def _select_images(sees: BearingMeasurements, key_s: Array) -> BearingMeasurements:
    """Return the images of a flight that are at keyframes."""
    inside = sees.crop(key_s[0], key_s[-1])
    gap_s = inside.time_s - key_s[nearest_keyframe(key_s, inside.time_s)]
    return inside.take(np.abs(gap_s) <= MAX_IMAGE_SHIFT_S)


def _collect_known(
    pairs: Mapping[tuple[int, int], Pair],
) -> dict[tuple[str, tuple[int, ...]], float]:
    """Return the known standard deviations of all pairs by the robots of the flight."""
    out: dict[tuple[str, tuple[int, ...]], float] = {}
    for both, pair in pairs.items():
        for (name, own), std in pair.known_std.items():
            subject = name, tuple(both[side] for side in own)
            out[subject] = min(std, out.get(subject, np.inf))
    return out


def nearest_keyframe(key_s: Array, time_s: Array) -> NDArray[np.intp]:
    """Return (N,) the keyframe nearest to each time."""
    place = np.rint(np.interp(time_s, key_s, np.arange(len(key_s))))
    return np.asarray(place, np.intp)


def _cut_steps(time_s: Array, track: SensorTrack, key_s: Array) -> Steps:
    """Cut the log of one robot."""
    path = preintegrate(track, time_s)
    motion = path.relative_motion(key_s[:-1], key_s[1:])
    half_s = 2 * float(time_s[1] - time_s[0])
    late, early = (
        path.relative_motion(key_s[:-1] + lag, key_s[1:] + lag) for lag in (half_s, -half_s)
    )
    by_clock = np.column_stack([late.shift_m - early.shift_m, late.turn_rad - early.turn_rad])
    masks = (track.dropout, track.dropout if track.turn_dropout is None else track.turn_dropout)
    gaps_s = [np.cumsum(mask) * (time_s[1] - time_s[0]) for mask in masks]
    dropout_s, turn_dropout_s = (np.diff(np.interp(key_s, time_s, gap_s)) for gap_s in gaps_s)
    return Steps(
        np.diff(key_s),
        motion,
        by_clock / (2 * half_s),
        dropout_s,
        turn_dropout_s,
        path,
        np.interp(key_s, time_s, track.height_m),
    )


def _cut_link(
    both: tuple[int, int], pair: Pair, robots: Sequence[Steps], key_s: Array
) -> RangeLink:
    """Cut the ranges of a pair."""
    inside = (pair.range_time_s >= key_s[0]) & (pair.range_time_s <= key_s[-1])
    at_s = pair.range_time_s[inside]
    key = nearest_keyframe(key_s, at_s)
    own, peer = (robots[k].path.relative_motion(key_s[key], at_s).shift_m for k in both)
    height_m = np.interp(at_s, pair.time_s, pair.peer.height_m - pair.own.height_m)
    guess = range_step_offsets(pair)[inside]
    ones = np.ones(len(key))
    sent = ones / 2 if pair.range_sender is None else 1.0 - pair.range_sender[inside]
    return RangeLink(both, key, at_s, pair.range_m[inside], ones, own, peer, height_m, guess, sent)


def _cut_view(
    both: tuple[int, int],
    sees: BearingMeasurements,
    pair: Pair,
    robots: Sequence[Steps],
    key_s: Array,
) -> CameraView:
    """Cut the detections of one camera of a pair."""
    key = nearest_keyframe(key_s, sees.time_s)
    own, peer = (robots[k].path.relative_motion(key_s[key], sees.time_s) for k in both)
    up = pair.peer.height_m - pair.own.height_m
    height_m = np.interp(sees.time_s, pair.time_s, up if both[0] < both[1] else -up)
    around = [np.searchsorted(sees.time_s, sees.time_s + s * CORRELATION_S / 2) for s in (-1, 1)]
    weight = 1 / np.maximum(around[1] - around[0], 1)
    return CameraView(
        both, key, own.shift_m, peer.shift_m, own.turn_rad, height_m,
        sees.bearing, sees.std, weight, sees.time_s,
    )  # fmt: skip


def range_step_offsets(pair: Pair) -> Array:
    """Return (R,) the detected step offset of every range of a pair, metres."""
    if not len(pair.range_m):
        return pair.range_m
    block = ((pair.range_time_s - pair.time_s[0]) / RANGE_BLOCK_S).astype(int)
    blocks, inverse = np.unique(block, return_inverse=True)
    ends = np.cumsum(np.bincount(inverse, minlength=len(blocks)))
    middle = np.array([np.median(part) for part in np.split(pair.range_m, ends[:-1])])
    # The distance changes at most as fast as both robots fly, also between ranges of a slow log.
    at_s = pair.time_s[0] + (blocks + 0.5) * RANGE_BLOCK_S
    way_m = np.interp(at_s, pair.time_s, sum_ways(pair))
    after = np.arange(len(blocks)) + RANGE_MEDIAN_BLOCKS // 2
    numbers = (np.clip(k, 0, len(blocks) - 1) for k in (after, after - RANGE_MEDIAN_BLOCKS))
    late, early = (way_m[k] for k in numbers)
    moved_m = late - early
    step_s = RANGE_BLOCK_S * (float(np.median(np.diff(blocks))) if len(blocks) > 1 else 1.0)
    found = step_offsets(middle, step_s, MIN_RANGE_STEP_M, RANGE_MEDIAN_BLOCKS, moved_m)
    return np.asarray(found[inverse])


def sum_ways(pair: Pair) -> Array:
    """Return (K,) the length of the ways of both robots up to each time, metres."""
    speed = sum(np.hypot(track.vx_mps, track.vy_mps) for track in (pair.own, pair.peer))
    return np.asarray(np.cumsum(speed) * pair.dt_s)


def average_ranges(link: RangeLink, key_s: Array) -> RangeLink:
    """Return one range per keyframe: the median, without step offset and trend.

    Parameters
    ----------
    link
        Ranges of a pair.
    key_s
        (K,) times of the keyframes, seconds.
    """
    if not len(link.range_m):
        return link
    level = link.range_m - link.offset_guess_m
    rough = _medians(link.keyframe, level)
    keys = np.unique(link.keyframe)
    rate = np.gradient(rough, key_s[keys]) if len(keys) > 1 else np.zeros(1)
    late_s = link.time_s - key_s[link.keyframe]
    trend = np.interp(key_s[link.keyframe], key_s[keys], rate) * late_s
    count = np.bincount(link.keyframe)[keys]
    first = np.cumsum(count) - count
    height, guess, sent = (
        np.add.reduceat(v, first) / count for v in (link.height_m, link.offset_guess_m, link.sent)
    )
    none = np.zeros((len(keys), 2))
    # A median of n values has pi/2 / n of the variance of one.
    std = np.sqrt(np.pi / 2 / count)
    middle = _medians(link.keyframe, level - trend)
    return RangeLink(link.robots, keys, key_s[keys], middle, std, none, none, height, guess, sent)


def _medians(key: NDArray[np.intp], values: Array) -> Array:
    """Return the median of the values of each distinct key; the keys are sorted."""
    ordered, count = values[np.lexsort((values, key))], np.unique(key, return_counts=True)[1]
    first = np.cumsum(count) - count
    return np.asarray((ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2)


def odometry_dropout(pair: Pair, time_s: Array) -> Mask:
    """Return (K,) whether a sensor of either robot dropped out for over half a second."""
    gap = pair.own.dropout | pair.peer.dropout
    for track in (pair.own, pair.peer):
        if track.height_dropout is not None:
            gap = gap | track.height_dropout
    low = np.clip(np.searchsorted(pair.time_s, time_s, "right") - 1, 0, len(gap) - 2)
    return np.asarray(gap[low] | gap[low + 1])


def range_dropout(pair: Pair, time_s: Array) -> Mask:
    """Return (K,) whether the ranges dropped out for over half a second; a slow log for longer."""
    edges = np.concatenate([[-np.inf], pair.range_time_s, [np.inf]])
    after = np.clip(np.searchsorted(edges, time_s), 1, len(edges) - 1)
    return np.asarray(edges[after] - edges[after - 1] > longest_range_gap_s(pair))


def longest_range_gap_s(pair: Pair) -> float:
    """Return the longest time between two ranges that is no dropout, seconds."""
    return longest_gap_s(pair.range_time_s[::2])  # two robots may range in turn


def list_robots(pairs: Collection[tuple[str, str]]) -> list[str]:
    """Return the names of all robots of pairs, in order."""
    return sorted({name for both in pairs for name in both})
