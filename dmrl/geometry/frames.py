"""Coordinate frames, cameras, projection and grid labels. Pure NumPy, without files or state.

Frames, all right-handed, metres and radians:

* ``horizontal``  origin at the robot, x forward, y left, z up against gravity.
* ``camera``      origin at the optical centre, x forward, y left, z up; horizontal
  rotated by roll and pitch.
* ``image``       pixels from the top-left corner, u right, v down, pixel-edge
  coordinates: an image covers [0, width] x [0, height].

A matrix that converts ``b`` coordinates to ``a`` coordinates is named ``a_from_b``.
A grid cell is (row, col) = (v, u) // stride; the paper writes (x_p / 8, y_p / 8).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.lens import distort, undistort

Array = NDArray[np.float64]

STRIDE_PX = 8
"""Image pixels per grid cell, in both directions."""

# camera (x forward, y left, z up) -> optical (x right, y down, z forward); paper eq. 1.
OPTICAL_FROM_CAMERA: Array = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera with radial-tangential distortion.

    Parameters
    ----------
    width_px, height_px
        Size of the image, pixels.
    fx_px, fy_px
        Focal lengths, pixels.
    cx_px, cy_px
        Principal point, pixel-edge coordinates.
    distortion
        k1, k2, p1, p2, k3 of the plumb-bob model; empty for none.
    mount_rad
        Roll, pitch and yaw of the camera relative to the robot's body. Signs as in
        ``camera_from_horizontal``, yaw positive to the left.
    delay_s
        Delay of an image's log time after its exposure, seconds.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    mount_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_s: float = 0.0

    @property
    def camera_from_body(self) -> Array:
        """(3, 3) rotation of the camera's mount."""
        roll, pitch, yaw = self.mount_rad
        return np.asarray(camera_from_horizontal(roll, pitch) @ yaw_matrix(yaw))

    def point_at(self, u_px: float, v_px: float, depth_m: float) -> Array:
        """Return (3,) the point at a pixel and a depth in the camera frame, without distortion."""
        left, up = (self.cx_px - u_px) / self.fx_px, (self.cy_px - v_px) / self.fy_px
        return np.array([depth_m, depth_m * left, depth_m * up])

    @property
    def image_from_optical(self) -> Array:
        """(3, 3) intrinsic matrix, pixels."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )


AIDECK = Camera(320, 224, 183.73, 184.12, 166.90, 77.51, (-0.0957, 0.0211, 0.0, 0.0, 0.0))
"""The AI-deck camera of the paper (eq. 1): 324x244 cropped to 320x224."""

AIDECK_SENSOR_PX, AIDECK_CORNER_PX = (324, 244), (2, 10)
"""Width and height of the AI-deck's whole sensor, and the corner of `AIDECK` in it."""

AIDECK_PINHOLE = replace(AIDECK, distortion=())
"""`AIDECK` without distortion. Used for flights and sketches."""

PUBLISHED_RENDER = Camera(320, 224, 120.0, 120.0, 160.0, 112.0)
"""Camera of the published synthetic images."""


def yaw_matrix(yaw_rad: float) -> Array:
    """Return (3, 3) the rotation into a frame that is turned about z by an angle."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def camera_from_horizontal(roll_rad: float, pitch_rad: float) -> Array:
    """Return the (3, 3) rotation from horizontal to camera coordinates.

    The body's attitude is Rz(yaw) Ry(pitch) Rx(roll), z up: roll positive right side down,
    pitch positive nose down. The paper's eq. 2, Rx(phi) Ry(theta), is this matrix with
    phi = -roll and theta = -pitch; with standard signs it is a different rotation.

    Parameters
    ----------
    roll_rad, pitch_rad
        Attitude of the robot that carries the camera, radians.
    """
    cr, sr, cp, sp = np.cos(roll_rad), np.sin(roll_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    horizontal_from_camera = np.array(
        [[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]]
    )
    return horizontal_from_camera.T


def project(xyz_camera: Array, image_from_optical: Array) -> tuple[Array, Array]:
    """Project points in front of the camera, without distortion (paper eq. 1).

    Parameters
    ----------
    xyz_camera
        (N, 3) points, camera frame, metres.
    image_from_optical
        (3, 3) intrinsic matrix, pixels.

    Returns
    -------
    uv : Array
        (N, 2) pixels, u right and v down. Not clipped to the image.
    depth_m : Array
        (N,) distance along camera x, metres.

    Raises
    ------
    ValueError
        If a point lies at or behind the optical centre (x <= 0).

    Examples
    --------
    >>> k = np.array([[184.0, 0.0, 160.0], [0.0, 184.0, 112.0], [0.0, 0.0, 1.0]])
    >>> project(np.array([[2.0, 0.0, 0.0]]), k)
    (array([[160., 112.]]), array([2.]))
    """
    depth_m = xyz_camera[:, 0]
    if (behind := np.flatnonzero(depth_m <= 0)).size:
        raise ValueError(
            f"{behind.size} of {depth_m.size} points lie behind the camera, "
            f"first at row {behind[0]} with x = {depth_m[behind[0]]:.3f} m"
        )
    uvw = xyz_camera @ (image_from_optical @ OPTICAL_FROM_CAMERA).T
    return uvw[:, :2] / uvw[:, 2:], depth_m


def is_inside(uv: NDArray[np.floating], width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Return (...) whether pixels are in the image, [0, width) x [0, height).

    Parameters
    ----------
    uv
        (..., 2) pixels.
    width_px, height_px
        Size of the image.
    """
    return np.asarray(((uv >= 0) & (uv < (width_px, height_px))).all(axis=-1))


def build_grid_label(
    uv: Array, depth_m: Array, *, shape: tuple[int, int] = (28, 40), stride_px: int = STRIDE_PX
) -> NDArray[np.float32]:
    """Build confidence and depth maps of one image (paper eq. 4).

    Parameters
    ----------
    uv
        (N, 2) pixels of the robot centres.
    depth_m
        (N,) depths, metres; 0: unknown.
    shape
        Rows and columns of the grid.
    stride_px
        Pixels per cell, in both directions.

    Returns
    -------
    Array
        (2, rows, cols). Channel 0 is confidence, 0 or 1. Channel 1 is depth in metres, 0 where the
        confidence is 0 or the depth is unknown. Robots outside the image are ignored. Of two robots
        in one cell, the nearer one is used because it hides the other.
    """
    rows, cols = shape
    grid = np.zeros((2, rows, cols), np.float32)
    seen = is_inside(uv, cols * stride_px, rows * stride_px)
    uv, depth_m = uv[seen], depth_m[seen]
    distance_m = np.where(depth_m > 0, depth_m, np.inf)
    order = np.argsort(-distance_m, kind="stable")  # far first, so that near overwrites
    col, row = (uv[order] // stride_px).astype(int).T
    grid[0, row, col] = 1.0
    grid[1, row, col] = depth_m[order]
    return grid


def pixels_from_horizontal(
    xyz_horizontal: Array,
    roll_rad: Array,
    pitch_rad: Array,
    camera: Camera,
    *,
    distorted: bool = True,
) -> tuple[Array, Array, Array]:
    """Project points in the horizontal frame, and return pixels, depths and derivatives.

    Paper eq. 2 with the sign rule of ``camera_from_horizontal``, then eq. 1.

    Parameters
    ----------
    xyz_horizontal
        (N, 3) points, metres.
    roll_rad, pitch_rad
        (N,) attitude of the robot that carries the camera.
    camera
        Intrinsics and distortion.
    distorted
        Whether the image has the lens's distortion.

    Returns
    -------
    uv : Array
        (N, 2) pixels, not clipped to the image; NaN at or behind the optical centre.
    depth_m : Array
        (N,) along camera x, metres; negative behind.
    jacobian : Array
        (N, 3, 5) derivative of u, v (px) and depth (m) by x, y, z (m), roll and pitch (rad).
    """
    cr, sr, cp, sp = np.cos(roll_rad), np.sin(roll_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    zero = np.zeros_like(cr)

    def stack_matrices(*entries: Array) -> Array:
        return np.stack(entries, axis=-1).reshape(-1, 3, 3)

    # Rows of camera_from_horizontal, and of its derivatives.
    turn = stack_matrices(cp, zero, -sp, sp * sr, cr, cp * sr, sp * cr, -sr, cp * cr)
    by_roll = stack_matrices(zero, zero, zero, sp * cr, -sr, cp * cr, -sp * sr, -cr, -cp * sr)
    by_pitch = stack_matrices(-sp, zero, -cp, cp * sr, zero, -sp * sr, cp * cr, zero, -sp * cr)
    if any(camera.mount_rad):
        turn, by_roll, by_pitch = (camera.camera_from_body @ m for m in (turn, by_roll, by_pitch))
    point = xyz_horizontal[:, :, None]
    by_state = np.concatenate([turn, by_roll @ point, by_pitch @ point], axis=2)
    depth, left, up = (turn @ point)[..., 0].T
    # Points behind the camera have no pixel. Division by their depth would give a false one.
    ahead = np.where(depth > 0, depth, np.nan)
    plane = np.stack([-left / ahead, -up / ahead], axis=-1)

    # Chain rule: state to camera, to the plane at unit depth, through the lens, to pixels.
    by_camera = np.zeros((len(plane), 2, 3))
    by_camera[:, :, 0] = -plane / ahead[:, None]
    by_camera[:, 0, 1] = by_camera[:, 1, 2] = -1 / ahead
    bent, by_plane = distort(plane, camera.distortion if distorted else ())
    focal = np.array([camera.fx_px, camera.fy_px])
    uv = focal * bent + (camera.cx_px, camera.cy_px)
    jacobian = np.empty((len(plane), 3, 5))
    jacobian[:, :2] = focal[:, None] * (by_plane @ by_camera @ by_state)
    jacobian[:, 2] = by_state[:, 0]
    return uv, depth, jacobian


def horizontal_from_pixels(
    uv: Array,
    depth_m: Array,
    roll_rad: Array,
    pitch_rad: Array,
    camera: Camera,
    *,
    distorted: bool = True,
) -> Array:
    """Return (N, 3) points in the horizontal frame, metres. Inverse of ``pixels_from_horizontal``.

    Parameters
    ----------
    uv
        (N, 2) pixels.
    depth_m
        (N,) along camera x, metres.
    roll_rad, pitch_rad
        (N,) attitude of the robot that carries the camera.
    camera
        Intrinsics and distortion.
    distorted
        Whether the image has the lens's distortion.
    """
    plane = (uv - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    plane = undistort(plane, camera.distortion if distorted else ())
    ahead = np.column_stack([np.ones(len(plane)), -plane]) * depth_m[:, None]
    turns = [camera_from_horizontal(r, p) for r, p in zip(roll_rad, pitch_rad, strict=True)]
    # Points are rows: a product from the right applies the transpose, from camera to body.
    ahead = ahead @ camera.camera_from_body
    return np.asarray(np.einsum("nji,nj->ni", np.reshape(turns, (-1, 3, 3)), ahead))
