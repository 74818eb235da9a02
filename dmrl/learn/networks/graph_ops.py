"""The operations that a network consists of, as data without torch.

``trace`` makes such lists; whatever takes a network elsewhere, such as ``deploy``, reads them.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

IMAGE = "image"


@dataclass(frozen=True, slots=True)
class Op:
    """One operation.

    Parameters
    ----------
    kind
        "image", "conv", "norm", "relu", "max_pool", "add", "concatenate", "output"; or what
        torch calls it, where it is none of these.
    name
        Of the module, or of the operation in ``forward``.
    sources
        Names of the operations whose results it takes.
    values
        Its arrays: weight (out, in / groups, k, k) and bias (out,) of a conv; of a norm, the
        factor and the summand (channels,) that it comes to in use.
    settings
        Its numbers: kernel, stride, dilation, padding, groups. A pair where the two ways differ.
    """

    kind: str
    name: str
    sources: tuple[str, ...] = ()
    values: dict[str, Array] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
