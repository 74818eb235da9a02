"""Facts for the card that the columns of a dataset do not contain, stored beside them as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from dmrl import recipe
from dmrl.errors import DatasetError, RecipeError
from dmrl.guards.bounded_parsing import parse_json

FACTS_FILE = "facts.json"


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts from the creation of a dataset.

    Parameters
    ----------
    left_out
        Number of images left out, by reason.
    used
        Source of labels that was used, by recording.
    beside
        Other sources of labels in a recording, by recording.
    findings
        Findings of ``dmrl check`` about labels, by recording.
    licences
        Licences that were found beside the source files, by name.
    twins
        Images of test splits whose pixels are in train too.
    near
        Images of test splits with a near duplicate in train by perceptual hash, ``twins`` included.
    compared
        Images of test splits that were compared for ``near``. 0: all of them.
    sensors
        Patterns of the recordings' topics other than images and labels.
    cameras
        Calibration of the cameras in words, by recording and robot.
    """

    left_out: Mapping[str, int] = field(default_factory=dict)
    used: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, Sequence[str]] = field(default_factory=dict)
    findings: Mapping[str, Sequence[str]] = field(default_factory=dict)
    licences: Mapping[str, str] = field(default_factory=dict)
    twins: int = 0
    near: int = 0
    compared: int = 0
    sensors: Sequence[str] = ()
    cameras: Mapping[str, str] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write the facts into the folder of a dataset."""
        text = json.dumps(asdict(self), indent=1, sort_keys=True)
        (folder / FACTS_FILE).write_text(text + "\n", encoding="utf-8")


def read_facts(folder: Path) -> Facts | None:
    """Read the facts of a dataset; None if an older dmrl made it without.

    Raises
    ------
    DatasetError
        If the file is damaged.
    """
    path = folder / FACTS_FILE
    if not path.is_file():
        return None
    try:
        facts = recipe.check(path, parse_json(path.read_text(encoding="utf-8")), Facts)
        if facts.beside.keys() - facts.used.keys():
            raise ValueError("a recording has other sources of labels, but no source that is used")
        return facts
    except (OSError, ValueError, TypeError, AttributeError, RecipeError) as e:
        raise DatasetError(f"{path} cannot be read ({e}). Make the dataset again") from None


def merge_facts(parts: Sequence[Facts]) -> Facts:
    """Merge the facts of all parts; the leaks of the last part cover the whole dataset."""
    reasons = dict.fromkeys(why for part in parts for why in part.left_out)
    by_recording: dict[str, Any] = {
        name: {key: value for part in parts for key, value in getattr(part, name).items()}
        for name in ("used", "beside", "findings", "licences", "cameras")
    }
    return replace(
        parts[-1],
        left_out={why: sum(part.left_out.get(why, 0) for part in parts) for why in reasons},
        sensors=list(dict.fromkeys(pattern for part in parts for pattern in part.sensors)),
        **by_recording,
    )
