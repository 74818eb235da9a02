# Written by `make docs` from the stages' settings. Do not edit.
"""Settings of the stages in Python, by name and type."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal, TypedDict

class LabelSettings(TypedDict, total=False):
    method: Literal["swarm", "batch", "ekf"]
    preset: Literal["published-sim", "published-firmware"]
    gate_m: float
    bad_share: float
    attitude_std_rad: float
    detections: bool
    pixel_std_px: float
    range_offset_m: float
    sensors: str | PathLike[str] | None
    undistorted: bool
    copy: bool
    camera: Mapping[str, str | PathLike[str]]
    strict: bool

class PredictSettings(TypedDict, total=False):
    backend: Literal["torch", "onnx", "onnx-int8", "integer", "c", "riscv32"] | None
    threshold: float | None
    min_confidence: float
    most: int
    views: int
    magnify: bool
    batch_size: int
    strict: bool

class TrackSettings(TypedDict, total=False):
    threshold: float | None
    pixel_std_px: float
    depth_std_ratio: float
    depth_bias_ratio: float
    speed_std_mps: float
    tilt_bias_rad: float
    undistorted: bool
    camera: Mapping[str, str | PathLike[str]]

class AlignSettings(TypedDict, total=False):
    reference: str | None
    mocap: bool
    cameras: bool
    steady_cameras: bool

class TrimSettings(TypedDict, total=False):
    from_s: float | None
    to_s: float | None
    topic: Sequence[str]

class ConvertSettings(TypedDict, total=False):
    source_kind: str | None
    robot: str
    names: str | None
    rate_hz: float
    labels: str | PathLike[str] | None
    camera: str | PathLike[str] | None
    width_px: int | None
    height_px: int | None
    columns: str | PathLike[str] | None
    raw: bool
    bits: int
    as_stored: bool | None
    robot_width_m: float | None
    unlabelled: bool
    strict: bool
    to: Literal["csv", "parquet", "ros2", "yolo", "coco", "lerobot", "webdataset"] | None

class FlySettings(TypedDict, total=False):
    robots: int
    duration_s: float
    trajectory: Literal[
        "in_view",
        "random",
        "room",
        "lawn_mower",
        "hover",
        "parallel",
        "observer_static",
        "peer_static",
        "no_yaw",
        "both_static",
        "figure_of_eight",
    ]
    noise: Literal["ideal", "calibrated", "realistic", "harsh", "published"]
    seed: int
    place: int | None
    yaw_spread_rad: float
    camera: bool
    camera_renderer: Literal["sketch", "blender"]
    cameras_max: int
    camera_rate_hz: float
    faults: Sequence[Mapping[str, Any]]
    pilot: str
    flown: int
    distance_m: float
    eye: Literal["truth", "ideal"] | str | PathLike[str]
    backend: Literal["torch", "onnx", "onnx-int8", "integer", "c", "riscv32"] | None
    vision: Mapping[str, Any]

class RenderSettings(TypedDict, total=False):
    images: int
    seed: int
    workers: int
    samples: int
    camera: str | PathLike[str]
    distorted: bool
    design: Literal["crazyflie", "violet"]
    model: str | PathLike[str] | None
    model_up: Literal["auto", "y", "z"]
    model_centre: Literal["box", "origin"]
    scale: float
    cutouts: str | PathLike[str] | None
    cutout_width_m: float
    backgrounds: str | PathLike[str] | None
    lights: str | PathLike[str] | None
    masks: bool
    depths: bool
    rate_hz: float
    test_share: float
    empty_share: float
    robots_max: int
    place_u: Sequence[float]
    place_v: Sequence[float]
    depth_m: Sequence[float]
    depth_spacing: Literal["log", "linear"]
    robot_tilt_max_deg: float
    robot_turns: Literal["zyx", "xzy"]
    camera_tilt_max_deg: float
    speed_max_mps: float
    shutter_s: Sequence[float]
    shake_max_dps: float
    rotor_speed_rps: Sequence[float]
    rotors_stopped_share: float
    wear: Sequence[float]
    colour_spread: float
    painted_share: float
    light_strength: Sequence[float]
    sun_strength: Sequence[float]
    robot_gain: Sequence[float]
    robot_blur_px: Sequence[float]
    pasted: bool
    background_zoom: Sequence[float]
    recoloured_share: float
    background_contrast: Sequence[float]
    background_blur_px: Sequence[float]
    brightness: Sequence[float]
    contrast_gamma: Sequence[float]
    warmth: Sequence[float]
    saturation: Sequence[float]
    vignetting: Sequence[float]
    defocus_px: Sequence[float]
    bayer: bool
    shot_noise: Sequence[float]
    read_noise: Sequence[float]
    image_format: Literal["jpeg", "png"]
    jpeg_quality: Sequence[int]
    jpeg_subsampled: bool
    preset: str

class SketchSettings(TypedDict, total=False):
    images: int
    seed: int
    robots_max: int
    empty_share: float
    test_share: float

class DatasetSettings(TypedDict, total=False):
    labels: Literal["auto", "best", "truth", "estimate", "hand", "published"]
    keep_all: bool
    split: Literal["auto", "recordings", "none"]
    test_share: float
    val: str
    seed: int
    masks: bool
    pixels: Literal["raw", "png", "jpeg"]
    png: bool
    parquet: bool
    without: str | PathLike[str] | None
    corrections: Sequence[str | PathLike[str]]
    shard_images: int
    title: str
    license: str

class TrainSettings(TypedDict, total=False):
    confidence_weight: float
    focus: float
    depth_weight: float
    depth_loss: Literal["squared", "log"]
    offset_weight: float
    spread_weight: float
    class_weight: float
    consistency_weight: float
    classes: Sequence[str]
    architecture: str
    epochs: int
    epoch_images: int
    batch_size: int
    optimizer: Literal["muon", "adam"]
    learning_rate: float
    final_learning_rate: float
    warmup_epochs: int
    weight_decay: float
    ema_steps: int
    target_sigma_cells: float
    distill_share: float
    label_noise: Literal["ignore", "weight", "soften"]
    shares: Mapping[str, float]
    validation_share: float
    threshold: float | None
    false_alarms: float
    init_share: float
    hard_share: float
    flip_share: float
    zoom: Sequence[float]
    rotation_deg: float
    mosaic_share: float
    paste: float
    plain_epochs: int
    frozen_norm_epochs: int
    colour: float
    noise: float
    blur_share: float
    intrinsics: Sequence[float] | None
    grey_share: float
    precision: Literal["float32", "bfloat16"]
    seed: int
    device: Literal["auto", "cpu", "cuda"]
    processes: int

class QuantizeSettings(TypedDict, total=False):
    images: int
    grey: bool
    split: str | None
    most: int

class CalibrateSettings(TypedDict, total=False):
    board: str | None
    sensors: bool
    robot: str | None
    against: Literal["estimate", "truth"]
    camera: str | PathLike[str] | None
    threshold: float | None
    pixel_std_px: float
    attitude_std_rad: float
    every: int

class EvaluateSettings(TypedDict, total=False):
    what: Literal["auto", "detections", "flight", "positions", "tracks"]
    against: Literal["truth", "estimate", "hand", "published"]
    split: str | None
    partial: bool
    threshold: float | None
    false_alarms: float | None
    robot_width_m: float | None
    draws: int
    seed: int
    settle_s: float | None
