"""Plumb-bob lens distortion of the plane at unit depth, and its inverse. Pure NumPy.

Brown (1966), in the order of OpenCV and of ``foxglove.CameraCalibration``: k1, k2, p1, p2, k3.
Places are right and down, divided by depth.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NEWTON_STEPS = 8
"""Newton steps of the inverse. Lenses of small cameras converge to 1e-9 in 4."""


def distort(plane: Array, distortion: tuple[float, ...]) -> tuple[Array, Array]:
    """Map places of the plane through the lens, and return the derivatives.

    Parameters
    ----------
    plane
        (..., 2) right and down over depth.
    distortion
        k1, k2, p1, p2, k3 of the plumb-bob model. Missing ones are zero.

    Returns
    -------
    bent : Array
        (..., 2) in the same plane. NaN so far out that the model folds back.
    jacobian : Array
        (..., 2, 2).
    """
    k1, k2, p1, p2, k3 = (*distortion, *[0.0] * (5 - len(distortion)))
    x, y = plane[..., 0], plane[..., 1]
    square = x**2 + y**2
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    slope = k1 + square * (2 * k2 + square * 3 * k3)
    # Derivative of r * radial(r^2) by r. Below 0, places further out appear further in.
    radial = np.where(radial + 2 * square * slope > 0, radial, np.nan)
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    # Both mixed derivatives are equal, so the Jacobian is symmetric.
    across = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    along_x = radial + 2 * x**2 * slope + 2 * p1 * y + 6 * p2 * x
    along_y = radial + 2 * y**2 * slope + 6 * p1 * y + 2 * p2 * x
    jacobian = np.stack([along_x, across, across, along_y], axis=-1)
    return bent, jacobian.reshape(*plane.shape, 2)


def undistort(bent: Array, distortion: tuple[float, ...]) -> Array:
    """Return the (..., 2) places of the plane that ``distort`` maps to ``bent``.

    Parameters
    ----------
    bent
        (..., 2) distorted places, right and down over depth.
    distortion
        As in ``distort``.

    Returns
    -------
    Array
        NaN beyond the fold of the lens model.
    """
    # Newton's method starts at the distorted place, because distortion is small.
    plane = np.array(bent, float)
    for _ in range(NEWTON_STEPS if any(distortion) else 0):
        shown, jacobian = distort(plane, distortion)
        plane = plane - np.linalg.solve(jacobian, (shown - bent)[..., None])[..., 0]
    return plane
