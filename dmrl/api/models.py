"""A network as an object: images in, detections out."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from dmrl.api import notebook_display
from dmrl.deploy.backend_names import BackendName
from dmrl.deploy.detector import Detector, open_detector
from dmrl.errors import SettingError
from dmrl.learn.inference.decode_grids import DETECTION_COLUMNS, Grids, decode
from dmrl.learn.pretrained import resolve_model_path
from dmrl.storage import to_path

Rgb = NDArray[np.uint8]
BATCH_IMAGES = 16
"""Images that go through the network together."""


@dataclass(frozen=True, slots=True)
class Detection:
    """A robot that the network found in an image.

    Parameters
    ----------
    u_px, v_px
        Its centre, pixel-edge coordinates: the first pixel reaches from 0 to 1.
    depth_m
        Along the optical axis, metres.
    confidence
        0 to 1.
    sigma_depth_m
        Standard deviation of the depth, metres; 0 if the network has no such output.
    class_id
        Number of its class, 0 for a network without classes.
    """

    u_px: float
    v_px: float
    depth_m: float
    confidence: float
    sigma_depth_m: float = 0.0
    class_id: int = 0


class Model:
    """A network, opened with a backend.

    Parameters
    ----------
    detector
        Backend that turns images into grids.
    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector

    @property
    def name(self) -> str:
        """Name of its file or folder."""
        return self._detector.name

    @property
    def threshold(self) -> float:
        """Confidence from which a detection counts, 0 to 1."""
        return self._detector.threshold

    @property
    def stride_px(self) -> int:
        """Side of a cell of its grids, pixels."""
        return self._detector.stride_px

    def detect(
        self, images: Rgb | Sequence[Rgb], *, threshold: float | None = None, most: int = 20
    ) -> list[list[Detection]]:
        """Return the robots in each image, the most confident first.

        Parameters
        ----------
        images
            (N, H, W, 3) RGB, uint8, or a sequence of (H, W, 3), such as `Recording.images`, which
            is decoded a batch at a time. One image, (H, W, 3), is a sequence of one.
        threshold
            Least confidence, 0 to 1. None: the network's own threshold.
        most
            Most detections of an image.

        Raises
        ------
        SettingError
            If an image is not RGB and uint8, or of a size that the network cannot take; or if
            ``threshold`` or ``most`` is out of range.
        """
        if threshold is not None and not 0 <= threshold <= 1:
            raise SettingError(f"threshold = {threshold:g}. Give a confidence, 0 to 1")
        if most < 1:
            raise SettingError(f"most = {most}. Give 1 or more")
        if isinstance(images, np.ndarray) and images.ndim == 3:
            images = images[None]
        return list(self._iter_detections(images, threshold, most))

    def grids(self, images: Rgb) -> Grids:
        """Return the output of the network for (N, H, W, 3) RGB images, cell by cell.

        Returns
        -------
        Grids
            ``confidence`` and ``depth_m`` (N, rows, cols), and more if the network has it.
        """
        _require_rgb(images)
        self._detector.require_size(images.shape[2], images.shape[1], "the images")
        return self._detector.grids(np.ascontiguousarray(images))

    def _iter_detections(
        self, images: Rgb | Sequence[Rgb], threshold: float | None, most: int
    ) -> Iterator[list[Detection]]:
        least = self.threshold if threshold is None else threshold
        every = map(np.asarray, images)
        while batch := list(islice(every, BATCH_IMAGES)):
            for image in batch:
                _require_rgb(np.asarray(image)[None])
            if len({image.shape for image in batch}) > 1:
                raise SettingError("images of more than one size. Give those of each size alone")
            grids = self.grids(np.stack(batch))
            found = decode(*grids, stride_px=self.stride_px, most=most, min_confidence=least)
            columns = [getattr(found, name) for name in DETECTION_COLUMNS]
            for k, count in enumerate(found.count.tolist()):
                rows = zip(*(column[k, :count].tolist() for column in columns), strict=True)
                made = [Detection(**dict(zip(DETECTION_COLUMNS, row, strict=True))) for row in rows]
                # The decoder keeps the best of an image, however unsure.
                yield [d for d in made if d.confidence >= least]

    def __repr__(self) -> str:
        return f"<model {self.name}: threshold {self.threshold:.2f}, cells of {self.stride_px} px>"

    def _repr_html_(self) -> str:
        rows = [("threshold", self.threshold), ("side of a cell, px", self.stride_px)]
        return notebook_display.html_table(f"model {self.name}", ("", ""), rows)


def load(model: str | os.PathLike[str], *, backend: BackendName = "torch") -> Model:
    """Open a network.

    Parameters
    ----------
    model
        A run folder of dmrl train, a .safetensors, a Keras .h5, a quantised model, an export
        folder, or the name of one that ships with dmrl: "dmrl-nano".
    backend
        Backend: "torch" and "onnx" are float, "onnx-int8", "integer" (NumPy) and "c" int8.

    Raises
    ------
    ModelError
        If it cannot be used, or not by this backend.
    MissingExtra
        If a package that the backend needs is not installed.
    SettingError
        If there is no such backend.

    Examples
    --------
    >>> import dmrl
    >>> model = dmrl.load("dmrl-nano")  # doctest: +SKIP
    >>> model.detect(dmrl.open("flight.mcap").images("cf1"))  # doctest: +SKIP
    """
    return Model(open_detector(resolve_model_path(to_path(model)), backend))


def _require_rgb(images: Rgb) -> None:
    rgb = images.dtype == np.uint8 and images.ndim == 4 and images.shape[3] == 3
    if not rgb or 0 in images.shape[1:]:
        raise SettingError(
            f"images of shape {images.shape[1:]} and type {images.dtype}. Give (H, W, 3) RGB, uint8"
        )
