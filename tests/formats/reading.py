"""Help to read the samples of a source."""

from collections.abc import Iterable

from dmrl.samples.sample import Sample


def group_by_topic(samples: Iterable[Sample]) -> dict[str, list[Sample]]:
    """Return samples by topic, in their order."""
    found: dict[str, list[Sample]] = {}
    for sample in samples:
        found.setdefault(sample.topic, []).append(sample)
    return found
