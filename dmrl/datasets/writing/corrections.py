"""Read labels that a person corrected: recordings of source ``hand``, as the label desk saves them.

Each is of one recording, the first input of its provenance, and has PeerLabels for the corrected
images alone. They replace all labels of these images.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dmrl import topics
from dmrl.datasets.writing.exclusions import FlaggedImage
from dmrl.errors import SettingError
from dmrl.recording import read, read_summary

CORRECTION_SOURCE = "hand"

Corrections = Mapping[FlaggedImage, Sequence[Any]]
"""PeerLabel messages of each corrected image."""


def load_corrections(paths: Sequence[Path]) -> Corrections:
    """Read the corrected labels of all images.

    Raises
    ------
    SettingError
        If a recording does not say which recording it corrects, or two correct the same image.
    RecordingError
        If a recording cannot be read.
    """
    found: dict[FlaggedImage, Sequence[Any]] = {}
    for path in paths:
        made = read_summary(path).provenance
        if made is None or not made.inputs:
            raise SettingError(
                f"{path} does not say which recording it corrects. Save it with: dmrl view --flag"
            )
        for stamped in read(path, topics.LABELS("*")):
            robot = (topics.parse_topic(topics.LABELS, stamped.topic) or {})["robot"]
            key = (made.inputs[0].name, robot, stamped.time_ns)
            if key in found:
                raise SettingError(f"{path}: another file corrects {key} too. Leave one out")
            peers = stamped.message.peers
            found[key] = [one for one in peers if one.source == CORRECTION_SOURCE]
    return found


def find_corrected(recordings: Sequence[Path], corrections: Sequence[Path]) -> set[str]:
    """Return the names of the recordings that are corrected.

    Raises
    ------
    SettingError
        If the corrections are of none of the recordings, or one cannot be used.
    """
    named = {recording for recording, _, _ in load_corrections(corrections)}
    if named and not named & {path.name for path in recordings}:
        raise SettingError(
            f"{corrections[0]} corrects {', '.join(sorted(named))}, which is not among the "
            "recordings. Name that one, or leave out --corrections"
        )
    return named
