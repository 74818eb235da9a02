"""Assign rows to splits by recording, or as the source defines; neighbours stay together.

Two images a tenth of a second apart are nearly equal. A split that separates them into train and
test measures memory, not skill.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from dmrl.errors import RecordingError

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
