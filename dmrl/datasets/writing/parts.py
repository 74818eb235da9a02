"""Assign the splits of a dataset to its recordings."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from dmrl.datasets.writing.inputs import refuse_twins
from dmrl.datasets.writing.splits import SplitOf, held_out, held_out_alone, of_source
from dmrl.errors import SettingError
from dmrl.recording import Input, Provenance, splits, summary


def splits_of(
    recordings: Sequence[Path],
    made: Provenance,
    *,
    split: str,
    val: str,
    test_share: float,
    seed: int,
    there: Sequence[Input] | None = None,
) -> dict[Path, SplitOf]:
    """Return the split of every log time, by recording.

    Parameters
    ----------
    recordings
        Recordings of the dataset.
    made
        Its provenance, whose first inputs are these recordings.
    split, val, test_share, seed
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
    refuse_twins(recordings, made, there or ())
    watched = [path for path in recordings if fnmatchcase(path.name, val)]
    if val and not watched and there is None:
        names = ", ".join(path.name for path in recordings)
        raise SettingError(f"--val {val} matches none of {names}. Give another pattern")
    learnt = [path for path in recordings if path not in watched]
    own = {path: splits(path, summary(path)) for path in learnt if split == "auto"}
    by_source = {path: parts for path, parts in own.items() if parts}
    whole = {path: hashes[path] for path in learnt if path not in by_source}
    share = 0.0 if split == "none" else test_share
    test = held_out(whole, share, seed) if there is None else held_out_alone(whole, share, seed)
    named = {path: _constant("test" if path in test else "train") for path in whole}
    named |= {path: of_source(path, parts) for path, parts in by_source.items()}
    return named | {path: _constant("val") for path in watched}


def _constant(name: str) -> SplitOf:
    return lambda time_ns: name
