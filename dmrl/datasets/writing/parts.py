"""Assign the splits of a dataset to its recordings."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from dmrl.datasets.writing.inputs import refuse_twins
from dmrl.datasets.writing.splits import SplitOf, held_out, held_out_alone, of_source
from dmrl.errors import SettingError
from dmrl.recording import Input, Provenance


def splits_of(
    recordings: Mapping[Path, Mapping[str, Sequence[tuple[int, int]]]],
    made: Provenance,
    *,
    whole: bool,
    val: str,
    test_share: float,
    seed: int,
    there: Sequence[Input] | None = None,
) -> dict[Path, SplitOf]:
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
    refuse_twins(list(recordings), made, there or ())
    watched = [path for path in recordings if fnmatchcase(path.name, val)]
    if val and not watched and there is None:
        names = ", ".join(path.name for path in recordings)
        raise SettingError(f"--val {val} matches none of {names}. Give another pattern")
    learnt = [path for path in recordings if path not in watched]
    by_source = {path: recordings[path] for path in learnt if recordings[path]}
    rest = {path: hashes[path] for path in learnt if path not in by_source}
    share = 0.0 if whole else test_share
    test = held_out(rest, share, seed) if there is None else held_out_alone(rest, share, seed)
    named = {path: _constant("test" if path in test else "train") for path in rest}
    named |= {path: of_source(path, parts) for path, parts in by_source.items()}
    return named | {path: _constant("val") for path in watched}


def _constant(name: str) -> SplitOf:
    return lambda time_ns: name
