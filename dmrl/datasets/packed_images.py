"""Images that a dataset stores as PNG or JPEG, decoded when they are used."""

from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.errors import DatasetError
from dmrl.images.codec import decode


@dataclass(frozen=True, slots=True)
class PackedImages:
    """Encoded images of one record batch, indexed like an (n, H, W, 3) array.

    An index decodes its image each time, so that a dataset of any size needs the memory of the
    images in use. A slice decodes nothing. ``np.asarray`` decodes all.

    Parameters
    ----------
    encoded
        Binary array, one PNG or JPEG per image.
    image_shape
        Height, width and channels of every image.
    split
        Name of the split, for errors.
    """

    encoded: pa.Array
    image_shape: tuple[int, int, int]
    split: str

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Number of images, height, width and channels."""
        return (len(self.encoded), *self.image_shape)

    def __len__(self) -> int:
        return len(self.encoded)

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, index: slice) -> "PackedImages": ...

    def __getitem__(self, index: int | slice) -> "NDArray[np.uint8] | PackedImages":
        """Return the decoded image at an index, or the encoded images of a slice.

        Raises
        ------
        SourceError
            If the image cannot be decoded.
        DatasetError
            If it has another size than the grid labels.
        """
        if isinstance(index, slice):
            return PackedImages(self.encoded[index], self.image_shape, self.split)
        rgb = decode(self.encoded[index].as_py(), f"an image of split {self.split}")
        if rgb.shape != self.image_shape:
            raise DatasetError(
                f"an image of split {self.split} has another size than its labels. Make it again"
            )
        return rgb

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Decode all images."""
        if not len(self):
            return np.empty(self.shape, dtype or np.uint8)
        return np.stack([self[k] for k in range(len(self))]).astype(dtype or np.uint8, copy=False)
