"""Operations of a network as plain data, without torch.

`trace` makes lists of them. Exporters such as ``deploy`` read these lists.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

IMAGE_NAME = "image"


@dataclass(frozen=True, slots=True)
class Op:
    """One operation of a network.

    Parameters
    ----------
    kind
        "image", "conv", "norm", "relu", "max_pool", "add", "concatenate" or "output"; for any other
        operation, its torch name.
    name
        Name of the module, or of the operation in ``forward``.
    sources
        Names of the operations whose results it reads.
    values
        Arrays. Of a conv: weight (out, in / groups, k, k) and bias (out,). Of a norm in evaluation
        mode: factor and summand (channels,).
    settings
        Numbers: kernel, stride, dilation, padding, groups. A pair where height and width differ.
    """

    kind: str
    name: str
    sources: tuple[str, ...] = ()
    values: dict[str, Array] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
