"""Facts for the card that the columns of a dataset do not contain, stored beside them as JSON."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from dmrl.datasets.writing.near_duplicates import NEAR_DUPLICATE_BITS
from dmrl.errors import DatasetError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.safe_names import escape_markdown, markdown_code

FACTS_FILE = "facts.json"
MAX_LINES_OF_A_KIND = 20
"""Lines of one kind on a card, at most; facts.json has all."""
MAX_NAMES_ON_A_LINE = 3
"""Names on a line, at most."""


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


_DEFAULT_FACTS = Facts()
JSON_TYPES: Mapping[type, type | tuple[type, ...]] = {dict: dict, int: int, tuple: (list, tuple)}
"""JSON types that are accepted for a field of each type."""


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
        facts = Facts(**parse_json(path.read_text(encoding="utf-8")))
        for part in fields(Facts):
            if not isinstance(
                getattr(facts, part.name), JSON_TYPES[type(getattr(_DEFAULT_FACTS, part.name))]
            ):
                raise ValueError(f"{part.name} has the wrong type")
        if facts.beside.keys() - facts.used.keys():
            raise ValueError("a recording has other sources of labels, but no source that is used")
        list(provenance_lines(facts))
        list(sensor_lines(facts))
        return facts
    except (OSError, ValueError, TypeError, AttributeError) as e:
        raise DatasetError(f"{path} cannot be read ({e}). Make the dataset again") from None


def warning_lines(
    facts: Facts | None, sigmas: Mapping[str, Any], leaks: Iterable[str] = ()
) -> Iterator[str]:
    """Yield Markdown lines with the uncertainty of labels, warnings and leaks.

    Parameters
    ----------
    facts
        Facts of the dataset.
    sigmas
        By source of labels: (labels with a sigma, all labels, their median u, v, px, depth, m).
    leaks
        Lines about images and poses that test splits share with train.
    """
    yield from ("## Before you train", "")
    for source, (known, total, u_px, v_px, depth_m) in sorted(sigmas.items()):
        spread = f"median {u_px:.1f} px in u, {v_px:.1f} px in v, {depth_m:.2f} m in depth"
        words = f"{known} of {total} have a sigma, {spread}" if known else "none has a sigma"
        yield f"- Uncertainty of labels from {markdown_code(source)}: {words}."
    if facts is not None:
        yield from provenance_lines(facts)
    yield from leaks
    yield ""


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


def _comparison_words(facts: Facts) -> str:
    return f" of {facts.compared} compared images" if facts.compared else ""


def sensor_lines(facts: Facts) -> Iterator[str]:
    """Yield Markdown lines with the sensors and cameras of the recordings."""
    known = ", ".join(markdown_code(str(pattern)) for pattern in facts.sensors)
    yield f"- Other topics of the recordings: {known or 'none'}."
    alike: dict[str, list[str]] = {}
    for name, words in sorted(facts.cameras.items()):
        alike.setdefault(words, []).append(name)
    yield from _limit_lines(
        [
            f"- Camera of {_join_names(names)}: {escape_markdown(words)}."
            for words, names in alike.items()
        ]
    )
    if not facts.cameras:
        yield "- No recording has a camera calibration."


def provenance_lines(facts: Facts) -> Iterator[str]:
    """Yield Markdown lines: sources, findings, images left out, duplicates, licences."""
    beside = sorted(facts.beside.items())
    yield from _limit_lines(
        [_other_sources_line(facts.used[name], name, others) for name, others in beside]
    )
    found = [(name, words) for name, all_of in sorted(facts.findings.items()) for words in all_of]
    yield from _limit_lines(
        [f"- {markdown_code(name)}: {escape_markdown(words)}." for name, words in found]
    )
    if not facts.findings:
        yield "- `dmrl check` finds no bias in the labels. It can check those with boxes only."
    reasons = [
        f"{count:d} images {escape_markdown(why)}" for why, count in facts.left_out.items() if count
    ]
    yield f"- Left out: {'; '.join(reasons) or 'no image'}."
    yield (
        f"- Leaks: {facts.twins or 'no'} images of a test split have the pixels of one in train, "
        f"{facts.near or 'none'}{_comparison_words(facts)} are near duplicates of one in train: "
        "their "
        f"64-bit perceptual hashes differ by at most {NEAR_DUPLICATE_BITS} bits. Images with the "
        "same "
        "background often do."
    )
    licences = sorted(facts.licences.items())
    yield from _limit_lines(
        [f"- Licence of {markdown_code(n)}: {escape_markdown(words)}." for n, words in licences]
    )
    if not facts.licences:
        yield "- No licence was found beside the source files of the recordings."


def _other_sources_line(used: str, name: str, others: Sequence[str]) -> str:
    more = ", ".join(map(markdown_code, others))
    return (
        f"- {markdown_code(name)}: labels from {markdown_code(used)} are used. It also has "
        f"labels from {more}."
    )


def _join_names(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES_ON_A_LINE
    return ", ".join(map(markdown_code, names[:MAX_NAMES_ON_A_LINE])) + (
        f" and {more} more" if more > 0 else ""
    )


def _limit_lines(lines: Sequence[str]) -> Iterator[str]:
    yield from lines[:MAX_LINES_OF_A_KIND]
    if len(lines) > MAX_LINES_OF_A_KIND:
        yield f"- {len(lines) - MAX_LINES_OF_A_KIND} more lines of this kind are in `{FACTS_FILE}`."
