"""Messages of one rendered image: pixels, labels, true poses, masks and depth."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dmrl import topics
from dmrl.geometry.frames import Array, camera_from_horizontal
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.rendering.randomise import RandomScene
from dmrl.rendering.settings import Settings
from dmrl.rendering.shot import Robot, Shot
from dmrl.samples.sample import Sample, build_image, build_labels, to_timestamp

OBSERVER = "cf1"
"""Name of the robot that carries the camera."""


def peer_name(number: int, robot: Robot) -> str:
    """Return the name of the robot with this index in an image, counted from 0."""
    return f"{robot.make}{number + 2}"


def build_samples(
    time_ns: int, settings: Settings, scene: RandomScene, shot: Shot
) -> Iterator[Sample]:
    """Yield all samples of one rendered image.

    Parameters
    ----------
    time_ns
        Log time of the image, nanoseconds.
    settings
        Settings that select the topics and the image format.
    scene
        True poses.
    shot
        Pixels and labels.
    """
    jpeg = settings.image_format == "jpeg"
    data = (
        encode_jpeg(shot.rgb, scene.jpeg_quality, subsampled=settings.jpeg_subsampled)
        if jpeg
        else encode_png(shot.rgb)
    )
    yield build_labels(time_ns, OBSERVER, list(_iter_peer_labels(scene, shot)), ["truth"])
    attitude = {"roll_rad": scene.roll_rad, "pitch_rad": scene.pitch_rad}
    yield Sample(time_ns, topics.ATTITUDE(OBSERVER), "Attitude", attitude)
    horizontal_from_camera = camera_from_horizontal(scene.roll_rad, scene.pitch_rad).T
    for k, robot in enumerate(scene.robots):
        xyz = horizontal_from_camera @ robot.pose.xyz_camera
        yield _truth_sample(time_ns, peer_name(k, robot), xyz)
    yield _transforms_sample(time_ns, scene, horizontal_from_camera)
    # Images come last, so that a resumed recording gets identical chunks when it is copied.
    yield build_image(time_ns, OBSERVER, data, settings.image_format)
    if settings.masks:
        mask = encode_png(_instance_mask(shot))
        yield replace(build_image(time_ns, OBSERVER, mask, "png"), topic=topics.MASKS(OBSERVER))
    if settings.depths:
        depth = encode_png(np.round(shot.surface_m * 1000).astype(np.uint16))
        yield replace(build_image(time_ns, OBSERVER, depth, "png"), topic=topics.DEPTHS(OBSERVER))


def _iter_peer_labels(scene: RandomScene, shot: Shot) -> Iterator[dict[str, Any]]:
    """Yield the labels of robots that are visible and whose centre the lens can project."""
    for k, share in enumerate(shot.visible_share.tolist()):
        if share <= 0 or np.isnan([*shot.box_px[k], *shot.uv_px[k]]).any():
            continue
        yield {
            "peer": peer_name(k, scene.robots[k]),
            "u_px": float(shot.uv_px[k, 0]),
            "v_px": float(shot.uv_px[k, 1]),
            "depth_m": float(shot.depth_m[k]),
            "box_px": shot.box_px[k].tolist(),
            "visible_share": share,
            "source": "truth",
        }


def _instance_mask(shot: Shot) -> Any:
    """Return an (H, W) uint8 mask: number of the peer that covers most of a pixel, 0 for none."""
    if not len(shot.opacity):
        return np.zeros(shot.rgb.shape[:2], np.uint8)
    most = shot.opacity.max(axis=0)
    return np.where(most > 0, shot.opacity.argmax(axis=0) + 2, 0).astype(np.uint8)


def _truth_sample(time_ns: int, name: str, xyz: Array) -> Sample:
    fields = dict(zip("xyz", xyz.tolist(), strict=True))
    fields |= {"frame_id": f"{OBSERVER}/horizontal", "covariance": [0.0] * 9}
    return Sample(time_ns, topics.TRUTH(OBSERVER, name), "PeerPosition", fields)


def _transforms_sample(time_ns: int, scene: RandomScene, horizontal_from_camera: Array) -> Sample:
    """Return the true poses of camera and peers. The observer's horizontal frame is the world."""
    poses = [("world", f"{OBSERVER}/horizontal", np.zeros(3), np.eye(3))]
    poses.append(
        (f"{OBSERVER}/horizontal", f"{OBSERVER}/camera", np.zeros(3), horizontal_from_camera)
    )
    for k, robot in enumerate(scene.robots):
        xyz = horizontal_from_camera @ robot.pose.xyz_camera
        turn = horizontal_from_camera @ robot.pose.camera_from_body
        poses.append((f"{OBSERVER}/horizontal", peer_name(k, robot), xyz, turn))
    turns = Rotation.from_matrix(np.stack([turn for *_, turn in poses]))
    quaternions = turns.as_quat(canonical=True).tolist()
    transforms = [
        {
            "timestamp": to_timestamp(time_ns),
            "parent_frame_id": parent,
            "child_frame_id": child,
            "translation": dict(zip("xyz", xyz.tolist(), strict=True)),
            "rotation": dict(zip("xyzw", quaternion, strict=True)),
        }
        for (parent, child, xyz, _), quaternion in zip(poses, quaternions, strict=True)
    ]
    return Sample(time_ns, topics.TRANSFORMS, "FrameTransforms", {"transforms": transforms})
