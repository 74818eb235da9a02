"""Recordings that may not be put into one dataset: an image in train would be in test too."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from dmrl.errors import SettingError
from dmrl.recording import Input, Provenance


def refuse_twins(recordings: Sequence[Path], made: Provenance) -> None:
    """Nothing, if no two recordings share a name, bytes or images.

    Parameters
    ----------
    recordings
        To be put into one dataset.
    made
        Names them as its inputs, in their order.

    Raises
    ------
    SettingError
        If two do.
    """
    names: dict[str, Path] = {}
    contents: dict[str, Path] = {}
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
