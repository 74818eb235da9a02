"""Images of a camera in a recording, as a sequence that decodes an image when it is used."""

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from dmrl.api import notebook_display
from dmrl.api.topic import to_log_time
from dmrl.images.codec import Rgb, decode
from dmrl.messages import message_class
from dmrl.recording import parse_message, read_log_times, read_raw


@dataclass(frozen=True, eq=False)
class Images(Sequence[Rgb]):
    """Images of one camera, (H, W, 3) uint8 RGB each, in log-time order unless sliced otherwise.

    ``images[3]`` is an image, ``images[3:9]`` fewer images, ``images.between(1.0, 2.0)`` those
    of a second. Each is decoded when it is used.

    Parameters
    ----------
    path
        The recording.
    topic
        Topic of the camera.
    start_ns
        Log time from which seconds count, nanoseconds.
    time_ns
        (N,) log times of the images.
    ranks
        (N,) numbers of the images among those of their time, from 0.
    kept
        Object that keeps a temporary recording alive.
    """

    path: Path
    topic: str
    start_ns: int
    time_ns: NDArray[np.int64]
    ranks: NDArray[np.int64]
    kept: object = None

    @classmethod
    def load_topic(cls, path: Path, topic: str, start_ns: int, kept: object = None) -> "Images":
        """Return all images on a topic."""
        time_ns = read_log_times(path, [topic])[topic]
        ranks = np.arange(len(time_ns)) - np.searchsorted(time_ns, time_ns)
        return cls(path, topic, start_ns, time_ns, ranks, kept)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(N,) seconds from the start of the recording."""
        return np.asarray((self.time_ns - self.start_ns) * 1e-9)

    def __len__(self) -> int:
        return len(self.time_ns)

    @overload
    def __getitem__(self, index: int) -> Rgb: ...
    @overload
    def __getitem__(self, index: slice) -> "Images": ...
    def __getitem__(self, index: int | slice) -> "Rgb | Images":
        """Return an image by its number, or fewer images.

        Raises
        ------
        IndexError
            If there is no such number.
        """
        if isinstance(index, slice):
            return self._select(index)
        time_ns = int(self.time_ns[index])
        wanted = {(time_ns, int(self.ranks[index]))}
        return next(self._iter_decoded(time_ns, time_ns + 1, wanted))

    def __iter__(self) -> Iterator[Rgb]:
        """Yield the images; each chunk of the file is read once, unless they are out of order."""
        keys = list(zip(self.time_ns.tolist(), self.ranks.tolist(), strict=True))
        if any(before >= after for before, after in pairwise(keys)):
            yield from (self[k] for k in range(len(self)))
        elif keys:
            yield from self._iter_decoded(keys[0][0], keys[-1][0] + 1, set(keys))

    def _iter_decoded(
        self, start_ns: int, end_ns: int, wanted: Set[tuple[int, int]]
    ) -> Iterator[Rgb]:
        """Yield the images of some times and ranks, decoded, in log-time order."""
        kind, time_ns, rank = message_class("CompressedImage"), -1, 0
        for raw in read_raw(self.path, self.topic, start_ns=start_ns, end_ns=end_ns):
            rank = rank + 1 if raw.time_ns == time_ns else 0
            time_ns = raw.time_ns
            if (time_ns, rank) in wanted:
                what = f"{self.path}: the image of {self.topic} at {time_ns} ns"
                yield decode(parse_message(raw, kind, self.path).data, what)

    def _select(self, chosen: slice | NDArray[np.bool_]) -> "Images":
        return replace(self, time_ns=self.time_ns[chosen], ranks=self.ranks[chosen])

    def between(self, start_s: float | None = None, end_s: float | None = None) -> "Images":
        """Return the images in [start_s, end_s), seconds from the start of the recording."""
        low, high = (to_log_time(at_s, self.start_ns) for at_s in (start_s, end_s))
        chosen = np.ones(len(self), np.bool_)
        if low is not None:
            chosen &= self.time_ns >= low
        if high is not None:
            chosen &= self.time_ns < high
        return self._select(chosen)

    def nearest(self, time_s: float) -> Rgb:
        """Return the image nearest to a time, seconds from the start of the recording.

        Raises
        ------
        IndexError
            If there are no images here.
        """
        if not len(self):
            raise IndexError(f"no image here of {self.topic} in {self.path}")
        return self[int(np.abs(self.time_s - time_s).argmin())]

    def to_numpy(self) -> NDArray[np.uint8]:
        """Return all images as (N, H, W, 3), in memory; (0, 0, 0, 3) if there are none."""
        return np.stack(list(self)) if len(self) else np.empty((0, 0, 0, 3), np.uint8)

    def __repr__(self) -> str:
        return f"<{len(self)} images of {self.topic} in {self.path}>"

    def _repr_html_(self) -> str:
        return notebook_display.html_images(
            repr(self)[1:-1], (self[k] for k in notebook_display.pick_even_indices(len(self)))
        )
