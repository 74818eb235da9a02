"""Reject recordings that do not belong in one dataset: shared images, or different lenses."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from dmrl import topics
from dmrl.datasets.manifest import have_similar_focal_lengths
from dmrl.errors import SettingError
from dmrl.recording import Input, LoadedRecording, Provenance
from dmrl.terminal.progress import say


def reject_duplicates(
    recordings: Sequence[Path], made: Provenance, there: Sequence[Input] = ()
) -> None:
    """Raise SettingError if two recordings share a name, their bytes or their images.

    Parameters
    ----------
    recordings
        Recordings of the new rows.
    made
        Provenance whose first inputs are these recordings, in their order.
    there
        Inputs of the dataset so far.
    """
    names = {one.name: Path(one.name) for one in there}
    contents = {one.sha256: Path(one.name) for one in there}
    for path, source in zip(recordings, made.inputs, strict=False):
        if (twin := names.setdefault(path.name, path)) is not path:
            raise SettingError(
                f"{twin} and {path} have the same name, so rows could not be traced. Rename one"
            )
        if (twin := contents.setdefault(source.sha256, path)) is not path:
            raise SettingError(f"{twin} and {path} hold the same bytes. Name only one of them")
    for path, source in zip(recordings, made.inputs, strict=False):
        # Both have the same images: one could be in train, the other in test.
        for twin in (contents[sha] for sha in _iter_source_hashes(source) if sha in contents):
            raise SettingError(f"{path} is made from {twin}. Name only one of them")


def _iter_source_hashes(recording: Input) -> Iterator[str]:
    """Yield the hashes of the files that a recording has its images from.

    Files behind a dataset are left out: renders over its images, and labels of a model that was
    trained on them, show other images.
    """
    made = recording.provenance
    if made is not None and made.stage != "dataset":
        for source in made.inputs:
            yield source.sha256
            yield from _iter_source_hashes(source)


def find_focal_lengths(held: LoadedRecording) -> list[float]:
    """Return the focal lengths of a recording's calibrated cameras, pixels."""
    found = []
    for topic in held.topics:
        if topics.parse_topic(topics.CALIBRATION, topic):
            first = (stamped.message.K for stamped in islice(held.iter_messages(topic), 1))
            found += [k[0] for k in first if len(k) == 9 and k[0] > 0]
    return found


def warn_about_lenses(focal_px: Sequence[float]) -> None:
    """Warn if the cameras differ: the size of a drone alone then gives no depth.

    Parameters
    ----------
    focal_px
        Focal lengths of all cameras.
    """
    if focal_px and not have_similar_focal_lengths(min(focal_px), max(focal_px)):
        say(
            f"the cameras have focal lengths from {min(focal_px):.0f} to {max(focal_px):.0f} px: "
            "a drone appears larger through the longer one, and a network estimates a smaller "
            "depth. Make one dataset for each"
        )
