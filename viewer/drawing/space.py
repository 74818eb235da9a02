"""Draw robots in 3D, with the relative positions of peers and their covariance.

Positions of peers are in the ``<robot>/horizontal`` frame; where the recording has /tf, that
frame moves in ``world``.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dmrl.colours import OWN_RGB, RGB, STATUS_RGB
from dmrl.geometry.frames import Array
from dmrl.rendering.robots import crazyflie
from dmrl.viewer.content.robot_motion import (
    Names,
    Poses,
    Positions,
    Ranges,
    parse_covariances,
    parse_vectors,
)
from dmrl.viewer.drawing.entity import (
    ELLIPSE_SIGMAS,
    LINE_UI,
    POINT_UI,
    Entity,
    camera_frame,
    horizontal_frame,
    image_frame,
    optical_frame,
)

FRUSTUM_M, AXES_M, NAME_ABOVE_M = 0.35, 0.12, 0.08
TRAIL_UI, RANGE_UI = -1.0, -0.75
BODY_COLOUR = (190, 190, 190)
OPTICAL_XYZW = [-0.5, 0.5, -0.5, 0.5]
"""The rotation camera_from_optical, as in the /tf of a flight."""


def draw_transform(frame: str, poses: Poses) -> Entity:
    """Draw the poses of a frame in its parent, at the log times of the poses."""
    count = len(poses.time_ns)
    columns = rr.Transform3D.columns(
        translation=poses.xyz,
        quaternion=poses.xyzw,
        child_frame=[frame] * count,
        parent_frame=[poses.parent] * count,
    )
    return Entity(f"/tf/{frame}", columns)


def build_fixed_frame(frame: str, parent: str, xyzw: Sequence[float] = (0, 0, 0, 1)) -> Entity:
    """Build a frame that is fixed in its parent."""
    turn = rr.Quaternion(xyzw=xyzw)
    place = rr.Transform3D(
        translation=(0, 0, 0), quaternion=turn, child_frame=frame, parent_frame=parent
    )
    return Entity(f"/tf/{frame}", style=(place,))


def draw_attitude(robot: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Draw the attitude of a robot's body relative to its horizontal frame."""
    roll, pitch = (batch[f"{name}_rad"].to_numpy() / 2 for name in ("roll", "pitch"))
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    columns = rr.Transform3D.columns(
        quaternion=np.stack([cp * sr, sp * cr, -sp * sr, cp * cr], axis=1),
        child_frame=[camera_frame(robot)] * batch.num_rows,
        parent_frame=[horizontal_frame(robot)] * batch.num_rows,
    )
    yield Entity(f"/tf/{camera_frame(robot)}", columns)


def draw_body(robot: str) -> Iterator[Entity]:
    """Draw a robot's shape, axes and name."""
    mesh = crazyflie.CRAZYFLIE.build_mesh()
    shape = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        albedo_factor=BODY_COLOUR,
    )
    yield Entity(
        f"/{robot}/body", style=(shape, rr.TransformAxes3D(AXES_M)), frame=camera_frame(robot)
    )
    name = rr.Points3D(
        [[0, 0, NAME_ABOVE_M]],
        radii=[LINE_UI / 10],
        colors=[OWN_RGB],
        labels=[robot],
        show_labels=True,
    )
    yield Entity(f"/{robot}/name", style=(name,), frame=horizontal_frame(robot))


def draw_frustum(robot: str, path: str, calibration: Mapping[str, Any]) -> Entity:
    """Draw a robot's field of view, with its image in it.

    Parameters
    ----------
    robot
        Its name.
    path
        Topic of the calibration.
    calibration
        Fields of foxglove.CameraCalibration.
    """
    pinhole = rr.Pinhole(
        image_from_camera=np.reshape(calibration["K"], (3, 3)),
        resolution=[calibration["width"], calibration["height"]],
        image_plane_distance=FRUSTUM_M,
        color=OWN_RGB,
        line_width=LINE_UI,
        parent_frame=optical_frame(robot),
        child_frame=image_frame(robot),
    )
    return Entity(path, style=(pinhole,))


def draw_positions(path: str, pair: Names, positions: Positions, source: str) -> Iterator[Entity]:
    """Draw a peer's positions and covariance, at the log times of the positions.

    An estimate that is not OK has the colour of its status.
    """
    frame = horizontal_frame(pair[0])
    colours = np.array([RGB[source], STATUS_RGB["UNCONVERGED"], STATUS_RGB["AMBIGUOUS"]], np.uint8)
    own = colours[np.clip(positions.status, 0, 2)]
    points = rr.Points3D.columns(positions=positions.xyz, colors=own)
    style = rr.Points3D.from_fields(radii=[POINT_UI])
    yield Entity(path, points, (style,), frame)
    yield from _draw_ellipsoids(
        f"{path}/covariance", frame, positions.xyz, positions.covariance, own
    )


def _draw_ellipsoids(
    path: str,
    frame: str,
    xyz: Array,
    covariance: Array,
    colours: NDArray[np.uint8],
    lengths: NDArray[np.intp] | None = None,
) -> Iterator[Entity]:
    """Draw an ellipsoid for each known covariance that is not zero; ``lengths``: number per row."""
    known = np.isfinite(covariance).all(axis=(1, 2)) & covariance.any(axis=(1, 2))
    if lengths is None and not known.any():
        return
    half_sizes, xyzw = _principal_axes(covariance[known])
    columns = rr.Ellipsoids3D.columns(
        centers=xyz[known], half_sizes=half_sizes, quaternions=xyzw, colors=colours[known]
    )
    lengths = np.ones(len(xyz), np.intp) if lengths is None else lengths
    row_of = np.repeat(np.arange(len(lengths)), lengths)
    columns = columns.partition(np.bincount(row_of[known], minlength=len(lengths)))
    style = rr.Ellipsoids3D.from_fields(
        fill_mode=rr.components.FillMode.MajorWireframe, line_radii=[LINE_UI / 2]
    )
    yield Entity(path, columns, (style,), frame)


def _principal_axes(covariance: Array) -> tuple[Array, Array]:
    """Return half axes (N, 3), metres, and directions (N, 4), quaternions, of ellipsoids."""
    variance, axes = np.linalg.eigh(covariance)
    # A rotation, not a reflection.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return ELLIPSE_SIGMAS * np.sqrt(np.maximum(variance, 0)), Rotation.from_matrix(axes).as_quat()


def draw_trail(path: str, frame: str, steps: Array, source: str) -> Entity:
    """Draw the step from each position to the next, (N, 2, 3); a view shows the last seconds."""
    style = rr.LineStrips3D.from_fields(colors=[RGB[source]], radii=[TRAIL_UI])
    return Entity(path, rr.LineStrips3D.columns(strips=_build_strips(steps)), (style,), frame)


def _build_strips(points: Array) -> pa.ListArray:
    """Convert (N, k, 3) points to N lines. rerun takes 20 us for each in a list of arrays."""
    kind = rr.components.LineStrip3DBatch([]).as_arrow_array().type
    flat = pa.array(points.astype(np.float32).reshape(-1))
    offsets = np.arange(len(points) + 1, dtype=np.int32) * points.shape[1]
    inner = pa.FixedSizeListArray.from_arrays(flat, type=kind.value_type)
    return pa.ListArray.from_arrays(pa.array(offsets), inner, type=kind)


def draw_ranges(
    path: str, robot: str, measured: Ranges, towards: Positions | None
) -> Iterator[Entity]:
    """Draw ranges as lines to the estimated peer, or as spheres without an estimate.

    Parameters
    ----------
    path, robot
        Topic of the ranges, and the robot that measured them.
    measured
        The ranges.
    towards
        Estimated or true positions of the peer.
    """
    range_m = measured.range_m
    frame = horizontal_frame(robot)
    if towards is None:
        sphere = rr.Ellipsoids3D.columns(
            centers=np.zeros((len(range_m), 3)), half_sizes=np.repeat(range_m[:, None], 3, axis=1)
        )
        thin = rr.Ellipsoids3D.from_fields(
            colors=[RGB["range"]],
            line_radii=[RANGE_UI / 2],
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        yield Entity(f"{path}/sphere", sphere, (thin,), frame)
        return
    there = towards.interpolate(measured.time_ns)
    length = np.linalg.norm(there, axis=1, keepdims=True)
    known = np.isfinite(length[:, 0]) & (length[:, 0] > 0)
    ends = there[known] / length[known] * range_m[known, None]
    ends = np.stack([np.zeros_like(ends), ends], axis=1)
    lines = rr.LineStrips3D.columns(strips=_build_strips(ends))
    style = rr.LineStrips3D.from_fields(colors=[RGB["range"]], radii=[RANGE_UI])
    yield Entity(f"{path}/line", lines.partition(known.astype(int)), (style,), frame)


def draw_tracks(path: str, robot: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Draw tracks of peers: position, name, velocity and covariance."""
    column, frame = batch["tracks"], horizontal_frame(robot)
    lengths = column.value_lengths().to_numpy()
    found = column.flatten()
    xyz = parse_vectors(found, "xyz")
    velocity = np.stack([found.field(f"v{axis}_mps").to_numpy() for axis in "xyz"], axis=1)
    peers, numbers = (found.field(name).to_pylist() for name in ("peer", "id"))
    pairs = zip(peers, numbers, strict=True)
    names = [f"{peer or 'track'} {number}" for peer, number in pairs]
    colour = RGB["track"]
    points = rr.Points3D.columns(positions=xyz, labels=names).partition(lengths)
    dot = rr.Points3D.from_fields(colors=[colour], radii=[POINT_UI], show_labels=True)
    yield Entity(path, points, (dot,), frame)
    # An arrow is as long as the motion in one second.
    arrows = rr.Arrows3D.columns(origins=xyz, vectors=velocity).partition(lengths)
    thin = rr.Arrows3D.from_fields(colors=[colour], radii=[LINE_UI])
    yield Entity(f"{path}/velocity", arrows, (thin,), frame)
    colours = np.full((len(xyz), 3), colour, np.uint8)
    covariance = parse_covariances(found.field("covariance"))
    yield from _draw_ellipsoids(f"{path}/covariance", frame, xyz, covariance, colours, lengths)
