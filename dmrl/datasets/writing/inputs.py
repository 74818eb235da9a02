"""Recordings that should not be put into one dataset: for their images, or for their lenses."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from dmrl import topics
from dmrl.errors import SettingError
from dmrl.recording import Contents, Input, Provenance
from dmrl.terminal.progress import say

SAME_LENS = 1.05
"""Most that the focal lengths of one dataset may differ by without a word, a ratio."""


def refuse_twins(recordings: Sequence[Path], made: Provenance, there: Sequence[Input] = ()) -> None:
    """Nothing, if no two recordings share a name, bytes or images.

    Parameters
    ----------
    recordings
        To be put into one dataset.
    made
        Names them as its inputs, in their order.
    there
        What the dataset holds already.

    Raises
    ------
    SettingError
        If two do.
    """
    names = {one.name: Path(one.name) for one in there}
    contents = {one.sha256: Path(one.name) for one in there}
    for path, source in zip(recordings, made.inputs, strict=False):
        if (twin := names.setdefault(path.name, path)) is not path:
            raise SettingError(
                f"{twin} and {path} have one name, so rows could not be traced. Rename one"
            )
        if (twin := contents.setdefault(source.sha256, path)) is not path:
            raise SettingError(f"{twin} and {path} hold the same bytes. Name only one of them")
    for path, source in zip(recordings, made.inputs, strict=False):
        # Its images are the other's: one would be in train, the other in test.
        for twin in (contents[sha] for sha in _shown_by(source) if sha in contents):
            raise SettingError(f"{path} is made from {twin}. Name only one of them")


def _shown_by(recording: Input) -> Iterator[str]:
    """Hashes of what a recording has its images from.

    Not of what went through a dataset: renders over its images, labels of a model that learned
    from them, show other images.
    """
    made = recording.provenance
    if made is not None and made.stage != "dataset":
        for source in made.inputs:
            yield source.sha256
            yield from _shown_by(source)


def focal_lengths(held: Contents) -> list[float]:
    """Focal lengths of a recording's cameras, pixels, as far as they are known."""
    found = []
    for topic in held.topics:
        if topics.names(topics.CALIBRATION, topic):
            first = (stamped.message.K for stamped in islice(held.messages(topic), 1))
            found += [k[0] for k in first if len(k) == 9 and k[0] > 0]
    return found


def warn_of_lenses(focal_px: Sequence[float]) -> None:
    """Say so if the cameras differ: from the size of a drone alone its depth is not known then.

    Parameters
    ----------
    focal_px
        Of all cameras.
    """
    if focal_px and max(focal_px) > SAME_LENS * min(focal_px):
        say(
            f"the cameras have focal lengths from {min(focal_px):.0f} to {max(focal_px):.0f} px: "
            "a drone looks larger through the longer one, and a network takes it for nearer. Make "
            "one dataset for each"
        )
