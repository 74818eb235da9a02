"""Check whether cameras see anything: frozen, black and plain images."""

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from dmrl.errors import DmrlError
from dmrl.images.codec import decode

IMAGES_MIN = 20
"""Images needed for a finding."""
DECODED_MAX = 20
"""Images that are decoded for each topic, evenly spaced."""
FROZEN_SHARE, BLIND_SHARE = 0.5, 0.5
"""Shares of the images that repeat the one before, and that show nothing, from which to report."""
DARK_MAX, PLAIN_MAX = 16, 4
"""Largest value (99 %) of a black image, and largest range (1 to 99 %) of a plain one, of 255."""


@dataclass(slots=True)
class ImageSamples:
    """Samples of the images of each camera."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Images by topic and what they are: seen, repeated, decoded, black, of one colour."""
    last_crc: dict[str, int] = field(default_factory=dict)

    def add_batch(self, topic: str, batch: pa.RecordBatch, total: int) -> None:
        """Add the images of a topic that has ``total`` of them."""
        every = max(total // DECODED_MAX, 1)
        for value in batch["data"]:
            data = value.as_buffer()
            crc = zlib.crc32(data)
            self.counts[topic, "repeated"] += self.last_crc.get(topic) == crc
            self.last_crc[topic] = crc
            if total >= IMAGES_MIN and self.counts[topic, "seen"] % every == 0:
                self._look_at(topic, data.to_pybytes())
            self.counts[topic, "seen"] += 1

    def _look_at(self, topic: str, data: bytes) -> None:
        try:
            low, high = np.percentile(decode(data)[::2, ::2], (1, 99))
        except DmrlError:
            return  # images that cannot be decoded are another finding
        self.counts[topic, "decoded"] += 1
        self.counts[topic, "black"] += bool(high <= DARK_MAX)
        self.counts[topic, "of one colour"] += bool(DARK_MAX < high <= low + PLAIN_MAX)

    def find_blind_cameras(self) -> Iterator[tuple[str, str]]:
        """Yield topic and text for each camera that is frozen, or sees nothing."""
        for topic in self.last_crc:
            seen, repeated, looked = (
                self.counts[topic, what] for what in ("seen", "repeated", "decoded")
            )
            if seen >= IMAGES_MIN and repeated > FROZEN_SHARE * seen:
                yield topic, f"{repeated} of {seen} images repeat the one before them"
            for what in ("black", "of one colour"):
                if (found := self.counts[topic, what]) > BLIND_SHARE * looked:
                    yield topic, f"{found} of {looked} images looked at are {what}. Is it covered?"
