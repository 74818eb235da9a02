"""Assign a split to every recording of a dataset, and to each of its images."""

import hashlib
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path

from dmrl.datasets.settings import Settings
from dmrl.datasets.writing.inputs import reject_duplicates
from dmrl.errors import RecordingError, SettingError
from dmrl.recording import Input, Provenance

SplitLookup = Callable[[int], str | None]
"""Maps a log time, nanoseconds, to the name of a split; None for an image in no split."""


def choose_test_recordings(sha256: Mapping[Path, str], test_share: float, seed: int) -> set[Path]:
    """Choose the recordings that become the test split, whole.

    Recordings are ordered by a hash of content and seed, independent of their names.

    Parameters
    ----------
    sha256
        Recordings and the hashes of their content.
    test_share
        Wanted share of the recordings. If the share is not 0 and there are two recordings or more,
        at least one is held out and at least one stays.
    seed
        Another seed gives another choice.
    """

    def rank(path: Path) -> str:
        return hashlib.sha256(f"{seed} {sha256[path]}".encode()).hexdigest()

    if test_share == 0 or len(sha256) < 2:
        return set()
    count = min(max(round(test_share * len(sha256)), 1), len(sha256) - 1)
    return set(sorted(sha256, key=rank)[:count])


def choose_test_independently(
    sha256: Mapping[Path, str], test_share: float, seed: int
) -> set[Path]:
    """Choose the test recordings among those that are added; see `choose_test_recordings`.

    The hash of each recording decides alone, so the choice does not depend on other recordings.
    """

    def draw_share(path: Path) -> float:
        digest = hashlib.sha256(f"{seed} {sha256[path]}".encode()).digest()
        return int.from_bytes(digest[:8], "big") / 2**64

    return {path for path in sha256 if draw_share(path) < test_share}


def build_split_lookup(path: Path, own: Mapping[str, Sequence[tuple[int, int]]]) -> SplitLookup:
    """Return the splits that a recording itself defines, as a function of log time.

    Parameters
    ----------
    path
        The recording, for errors.
    own
        By split: [start_ns, end_ns], both inclusive; see `dmrl.recording.splits`.

    Raises
    ------
    RecordingError
        If two splits share a time.
    """
    spans = sorted((start, end, name) for name, parts in own.items() for start, end in parts)
    starts = [start for start, _, _ in spans]
    for (_, end, name), (start, _, other) in pairwise(spans):
        if start <= end and name != other:
            raise RecordingError(
                f"{path}: its splits {name} and {other} share the time {start} ns. "
                "Convert it again, or ignore them with --split recordings"
            )

    def split_of(time_ns: int) -> str | None:
        index = bisect_right(starts, time_ns) - 1
        if index < 0 or time_ns > spans[index][1]:
            return None
        return spans[index][2]

    return split_of


def assign_splits(
    recordings: Mapping[Path, Mapping[str, Sequence[tuple[int, int]]]],
    made: Provenance,
    settings: Settings,
    there: Sequence[Input] | None,
) -> dict[Path, SplitLookup]:
    """Return the split of every log time, by recording.

    Parameters
    ----------
    recordings
        Recordings of the dataset, each with the split that its source defines, if it counts.
    made
        Its provenance, whose first inputs are these recordings.
    settings
        Of ``dmrl dataset``; here count ``split``, ``val``, ``test_share`` and ``seed``.
    there
        Inputs of the dataset so far. None: it is new.

    Raises
    ------
    SettingError
        If two recordings share a name or their content, one is made from another, or ``val``
        matches none.
    RecordingError
        If a recording defines its splits in an invalid form.
    """
    hashes = {path: source.sha256 for path, source in zip(recordings, made.inputs, strict=False)}
    reject_duplicates(list(recordings), made, there or ())
    watched = [path for path in recordings if fnmatchcase(path.name, settings.val)]
    if settings.val and not watched and there is None:
        names = ", ".join(path.name for path in recordings)
        raise SettingError(f"--val {settings.val} matches none of {names}. Give another pattern")
    learnt = [path for path in recordings if path not in watched]
    by_source = {path: recordings[path] for path in learnt if recordings[path]}
    rest = {path: hashes[path] for path in learnt if path not in by_source}
    share = 0.0 if settings.split == "none" else settings.test_share
    choose = choose_test_recordings if there is None else choose_test_independently
    test = choose(rest, share, settings.seed)
    named = {path: _constant_split("test" if path in test else "train") for path in rest}
    named |= {path: build_split_lookup(path, parts) for path, parts in by_source.items()}
    return named | {path: _constant_split("val") for path in watched}


def _constant_split(name: str) -> SplitLookup:
    return lambda time_ns: name
