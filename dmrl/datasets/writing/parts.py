"""Assign the splits of a dataset to its recordings."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from dmrl.datasets.writing.inputs import reject_duplicates
from dmrl.datasets.writing.splits import (
    SplitLookup,
    build_split_lookup,
    choose_test_independently,
    choose_test_recordings,
)
from dmrl.errors import SettingError
from dmrl.recording import Input, Provenance


def assign_splits(
    recordings: Mapping[Path, Mapping[str, Sequence[tuple[int, int]]]],
    made: Provenance,
    *,
    whole: bool,
    val: str,
    test_share: float,
    seed: int,
    there: Sequence[Input] | None = None,
) -> dict[Path, SplitLookup]:
    """Return the split of every log time, by recording.

    Parameters
    ----------
    recordings
        Recordings of the dataset, each with the split that its source defines, if it counts.
    made
        Its provenance, whose first inputs are these recordings.
    whole
        Whether all other recordings become train.
    val, test_share, seed
        The settings of ``dmrl dataset``.
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
    watched = [path for path in recordings if fnmatchcase(path.name, val)]
    if val and not watched and there is None:
        names = ", ".join(path.name for path in recordings)
        raise SettingError(f"--val {val} matches none of {names}. Give another pattern")
    learnt = [path for path in recordings if path not in watched]
    by_source = {path: recordings[path] for path in learnt if recordings[path]}
    rest = {path: hashes[path] for path in learnt if path not in by_source}
    share = 0.0 if whole else test_share
    test = (
        choose_test_recordings(rest, share, seed)
        if there is None
        else choose_test_independently(rest, share, seed)
    )
    named = {path: _constant_split("test" if path in test else "train") for path in rest}
    named |= {path: build_split_lookup(path, parts) for path, parts in by_source.items()}
    return named | {path: _constant_split("val") for path in watched}


def _constant_split(name: str) -> SplitLookup:
    return lambda time_ns: name
