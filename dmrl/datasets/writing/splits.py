"""Which split a row belongs to: by recording, or as its source says; never by neighbours.

Two images a tenth of a second apart are nearly the same image: a split that puts one in
train and the other in test measures memory, not skill.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from dmrl.errors import RecordingError

SplitOf = Callable[[int], str | None]
"""Log time, nanoseconds, to the name of a split; None for an image in no split."""


def held_out(sha256: Mapping[Path, str], test_share: float, seed: int) -> set[Path]:
    """Recordings that become the test split, whole.

    Their order is a hash of content and seed, so it depends on neither names nor order.

    Parameters
    ----------
    sha256
        Recordings and the hashes of their content.
    test_share
        Wanted share of the recordings. At least one is held out where there are two or
        more and the share is not 0; at least one stays.
    seed
        Another seed, another choice.
    """

    def rank(path: Path) -> str:
        return hashlib.sha256(f"{seed} {sha256[path]}".encode()).hexdigest()

    if test_share == 0 or len(sha256) < 2:
        return set()
    count = min(max(round(test_share * len(sha256)), 1), len(sha256) - 1)
    return set(sorted(sha256, key=rank)[:count])


def held_out_alone(sha256: Mapping[Path, str], test_share: float, seed: int) -> set[Path]:
    """Recordings that become test when they are added to what is there; see `held_out`.

    Each is drawn by its own hash, so it does not depend on which others come with it, or before.
    """

    def drawn(path: Path) -> float:
        digest = hashlib.sha256(f"{seed} {sha256[path]}".encode()).digest()
        return int.from_bytes(digest[:8], "big") / 2**64

    return {path for path in sha256 if drawn(path) < test_share}


def of_source(path: Path, own: Mapping[str, Sequence[tuple[int, int]]]) -> SplitOf:
    """The split that a recording itself gives each log time.

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
