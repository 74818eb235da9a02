"""Choose the source whose labels a dataset uses for a recording."""

from dmrl import topics
from dmrl.datasets.writing.corrections import CORRECTION_SOURCE
from dmrl.errors import SettingError
from dmrl.recording import LoadedRecording
from dmrl.recording.label_sources import SOURCE_FIELDS, collect_sources
from dmrl.samples.sample import LABEL_SOURCES

TRAINING_SOURCES = ("estimate", "truth", "hand", "published")
"""Sources of labels in the order of training.

Estimates come first: who labels a flight that has true positions wants to measure the estimates.
"""


def find_label_sources(held: LoadedRecording) -> set[str]:
    """Return every source of labels that a recording has."""
    present: set[str] = set()
    for topic in held.topics:
        if topics.parse_topic(topics.LABELS, topic):
            table = held.get_table(topic, SOURCE_FIELDS).combine_chunks()
            present |= collect_sources(*(table.column(name).chunk(0) for name in SOURCE_FIELDS))
    return present


def choose_label_source(held: LoadedRecording, wanted: str, *, corrected: bool = False) -> str:
    """Choose the source whose labels are used for a recording.

    Parameters
    ----------
    held
        A recording that `count_images` accepts, best with its labels loaded.
    wanted
        One of `LABEL_SOURCES`; "best" for the first of them that the recording has; "auto" for the
        first of `TRAINING_SOURCES`.
    corrected
        Whether corrections label its images: their source is that of a recording without labels.

    Raises
    ------
    SettingError
        If the recording has labels, but none from that source.
    """
    present = find_label_sources(held)
    order = {"best": LABEL_SOURCES, "auto": TRAINING_SOURCES}.get(wanted, (wanted,))
    if not present:
        return CORRECTION_SOURCE if corrected else order[0]
    usable = [source for source in order if source in present]
    if not usable:
        has = ", ".join(sorted(present))
        raise SettingError(f"{held.path} has no labels from {wanted}. Try one of --labels {has}")
    return usable[0]
