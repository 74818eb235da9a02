"""Sample images stored with an int8 model, on which its C is verified."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import ModelError
from dmrl.guards.bounded_parsing import load_npz

SAMPLES_NAME = "samples.npz"
SAMPLE_COUNT = 4
"""Number of images stored."""


def save_samples(images: NDArray[np.uint8], folder: Path) -> None:
    """Write (N, height, width, 3) RGB images into a folder."""
    np.savez_compressed(folder / SAMPLES_NAME, allow_pickle=False, images=images)


def load_samples(folder: Path) -> NDArray[np.uint8]:
    """Read the (N, height, width, 3) RGB images of a folder.

    Raises
    ------
    ModelError
        If there are none, or they are damaged.
    """
    file = folder / SAMPLES_NAME
    try:
        images = load_npz(file)["images"]
    except FileNotFoundError:
        raise ModelError(f"no {file}. Quantise the model again") from None
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as e:
        raise ModelError(f"{file} is damaged: {e}. Quantise the model again") from None
    if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise ModelError(f"{file} holds no RGB images. Quantise the model again")
    return images
