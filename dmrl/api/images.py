"""Images of a camera in a recording, as a sequence that decodes an image when it is used."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from dmrl.api import notebook_display
from dmrl.images.codec import Rgb, decode
from dmrl.messages import message_class
from dmrl.recording import parse_message, read_log_times, read_raw


@dataclass(frozen=True, eq=False)
class Images(Sequence[Rgb]):
    """Images of one camera, (H, W, 3) uint8 RGB each, in log-time order.

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
        (N,) log times of the images, sorted.
    kept
        Object that keeps a temporary recording alive.
    """

    path: Path
    topic: str
    start_ns: int
    time_ns: NDArray[np.int64]
    kept: object = None

    @classmethod
    def load_topic(cls, path: Path, topic: str, start_ns: int, kept: object = None) -> "Images":
        """Return all images on a topic."""
        return cls(path, topic, start_ns, read_log_times(path, [topic])[topic], kept)

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
            return replace(self, time_ns=self.time_ns[index])
        time_ns = int(self.time_ns[index])
        place = index % len(self) - int(np.searchsorted(self.time_ns, time_ns))
        every = list(self._iter_decoded(time_ns, time_ns + 1))
        return every[min(place, len(every) - 1)][1]

    def __iter__(self) -> Iterator[Rgb]:
        """Yield the images; each chunk of the file is read once."""
        if not len(self):
            return
        wanted = set(self.time_ns.tolist())
        for time_ns, image in self._iter_decoded(
            int(self.time_ns.min()), int(self.time_ns.max()) + 1
        ):
            if time_ns in wanted:
                yield image

    def _iter_decoded(self, start_ns: int, end_ns: int) -> Iterator[tuple[int, Rgb]]:
        kind = message_class("CompressedImage")
        for raw in read_raw(self.path, self.topic, start_ns=start_ns, end_ns=end_ns):
            what = f"{self.path}: the image of {self.topic} at {raw.time_ns} ns"
            yield raw.time_ns, decode(parse_message(raw, kind, self.path).data, what)

    def between(self, start_s: float | None = None, end_s: float | None = None) -> "Images":
        """Return the images in [start_s, end_s), seconds from the start of the recording."""
        low = -np.inf if start_s is None else start_s
        high = np.inf if end_s is None else end_s
        # In whole nanoseconds, as they stand in the file.
        since = self.time_ns - self.start_ns
        chosen = (since >= np.round(low * 1e9)) & (since < np.round(high * 1e9))
        return replace(self, time_ns=self.time_ns[chosen])

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
