"""Training configuration: every setting of ``dmrl train`` and its default."""

from dataclasses import dataclass, field, fields
from typing import Literal

from dmrl.learn.data.augment import Augmentation
from dmrl.learn.data.crops import Intrinsics
from dmrl.learn.data.targets import LabelNoise
from dmrl.learn.networks.architectures import CLASS_PREFIX, SPREAD_CHANNEL
from dmrl.learn.training.losses import TERMS, LossSettings
from dmrl.learn.training.optimizer import OptimizerName

DEFAULT_ARCHITECTURE, AUTO = "dmrl-nano", "auto"


@dataclass(frozen=True, slots=True)
class TrainConfig(LossSettings):
    """Settings of a training run; those of the loss are in `LossSettings`.

    Parameters
    ----------
    architecture
        Name of the network. auto: that of the model to start from, or dmrl-nano if there is none.
    epochs
        Number of epochs of ``epoch_images`` images. 0: calibrate the model to start from anew.
    epoch_images
        Images per epoch, drawn with repetition from a small dataset and as a sample from a large
        one. 0: the size of the dataset.
    batch_size
        Images per step.
    optimizer
        "muon": Muon for kernels that mix channels, AdamW for the rest.
        "adam": Adam as published or, with a weight decay, AdamW.
    learning_rate
        Learning rate at the end of the warm-up.
    final_learning_rate
        Learning rate at the last step, after a half cosine.
    warmup_epochs
        Epochs over which the learning rate rises linearly from zero.
    weight_decay
        Decoupled weight decay of the convolution weights. 0 with "adam": plain Adam.
    ema_steps
        Time constant of the exponential moving average (EMA) of the weights, steps. The saved model
        has the averaged weights. 0: no EMA, the last weights are saved.
    target_sigma_cells
        Width (one sigma) of a robot in the confidence targets, cells. 0: one cell, as published.
    distill_share
        Weight of the distillation loss if there is a teacher, 0 to 1; the labels have the rest.
    label_noise
        Use of the labels' sigmas: "ignore" them, "weight" the cells, or "soften" the targets.
    shares
        Fraction of an epoch by recording: patterns of recording names, as in
        { "flight-*" = 0.7, "renders*" = 0.3 }. Empty: every image once.
    validation_share
        Fraction of the training images held out to select the threshold, if the dataset has no
        split named val. These are the last images of each recording, so that neighbours in time
        stay together.
    threshold
        Confidence from which the model reports a detection, 0 to 1. None: the threshold with the
        best F1 on held-out images that satisfies ``false_alarms``, or 0.33 if these contain fewer
        than 10 robots.
    false_alarms
        Largest mean number of detections at or above the threshold in a held-out image without a
        robot. With fewer than 100 such images, rooms that dmrl draws are added.
    init_share
        Weight of the initial model in the saved weights, 0 to 1, against forgetting (Wortsman et
        al. 2022). 0: the trained weights only.
    hard_share
        Fraction of an epoch that consists of images without a robot. Each is drawn in proportion to
        the square of the network's highest confidence in it, which is measured before every epoch.
        0: these images are drawn as often as others.
    flip_share
        Probability of a left-right mirrored window.
    zoom
        Smallest and largest magnification. Depth labels are scaled with it and stay within the
        range of the labels.
    rotation_deg
        Largest rotation about the optical axis, either way.
    mosaic_share
        Probability that an image is a mosaic of two or four windows.
    paste
        Mean number of patches of other images pasted into one. Requires labels with boxes.
    plain_epochs
        Number of last epochs with weak augmentation: mirroring and colours, but no zoom, rotation,
        mosaic or pasted patches (Ge et al. 2021).
    frozen_norm_epochs
        Number of last epochs in which batch normalisation uses its running statistics, as in
        inference, instead of those of the batch.
    colour
        Spread (one sigma) of contrast, brightness and white balance, 0 to 1.
    noise
        Largest sigma of sensor noise, 0 to 1 of full scale.
    blur_share
        Probability of a slight defocus.
    intrinsics
        fx, fy, cx and cy, pixels, of a camera whose images have no distortion. With them, a window
        is the view of a rotated camera. Without them, it is a crop and keeps the perspective
        stretch of its source position.
    grey_share
        Probability that colours are removed, for models that shall also work with grey cameras.
    precision
        "bfloat16": body in bfloat16, weights, head and losses in float32; 1.5 times as fast on CPUs
        that compute in bfloat16. Other CPUs compute in float32.
    seed
        Seed of the initial weights, the image order and the augmentation.
    device
        Compute device; auto selects CUDA if available.
    processes
        Processes that share every batch, on a CPU. One process per core is faster than one process
        with as many threads. With the same number of processes, weights are byte-identical. Under
        torchrun, its number of processes applies.
    """

    architecture: str = DEFAULT_ARCHITECTURE
    epochs: int = 60
    epoch_images: int = 0
    batch_size: int = 16
    optimizer: OptimizerName = "muon"
    learning_rate: float = 4e-3
    final_learning_rate: float = 1e-5
    warmup_epochs: int = 2
    weight_decay: float = 1e-2
    ema_steps: int = 500
    target_sigma_cells: float = 0.7
    distill_share: float = 0.5
    label_noise: LabelNoise = "ignore"
    shares: dict[str, float] = field(default_factory=dict)
    validation_share: float = 0.1
    threshold: float | None = None
    false_alarms: float = 0.02
    init_share: float = 0.0
    hard_share: float = 0.0
    flip_share: float = 0.5
    zoom: tuple[float, float] = (0.6, 1.6)
    rotation_deg: float = 8.0
    mosaic_share: float = 0.5
    paste: float = 0.0
    plain_epochs: int = 0
    frozen_norm_epochs: int = 0
    colour: float = 0.05
    noise: float = 0.01
    blur_share: float = 0.1
    intrinsics: Intrinsics | None = None
    grey_share: float = 0.0
    precision: Literal["float32", "bfloat16"] = "float32"
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    processes: int = 1

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            inside = value is None or low <= value <= high
            _raise_if(not inside, f"{name}: must be between {low} and {high}")
        falls = 0 <= self.final_learning_rate <= self.learning_rate
        _raise_if(
            self.learning_rate <= 0 or not falls,
            "learning_rate: must be over 0 and not below final_learning_rate",
        )
        least, greatest = self.zoom
        _raise_if(not 0 < least <= greatest, "zoom: must be over 0, the lesser first")
        camera = self.intrinsics or (1.0, 1.0)
        known = min(camera[:2]) > 0 and max(map(abs, camera)) <= MAX_SETTING
        _raise_if(not known, f"intrinsics: fx and fy must be over 0, all at most {MAX_SETTING}")
        beyond = any(not 0 <= share <= MAX_SETTING for share in self.shares.values())
        _raise_if(beyond, f"shares: must be between 0 and {MAX_SETTING}")

    @property
    def extra_channels(self) -> tuple[str, ...]:
        """Channels of the network in addition to the architecture's own."""
        classes = tuple(f"{CLASS_PREFIX}{k}" for k in range(len(self.classes)))
        return (*([SPREAD_CHANNEL] if self.spread_weight else []), *classes)

    def augmentation(self, epoch: int) -> Augmentation:
        """Return the augmentation of an epoch, counted from 0."""
        whole = Augmentation(**{one.name: getattr(self, one.name) for one in fields(Augmentation)})
        return whole if epoch < self.epochs - self.plain_epochs else whole.without_geometry


MAX_SETTING = 10_000_000
"""Upper bound of settings without a tighter one."""
NON_NEGATIVE_SETTINGS = (
    *("epochs", "epoch_images", "learning_rate", "warmup_epochs", "weight_decay", "ema_steps"),
    *("target_sigma_cells", "focus", "rotation_deg", "plain_epochs", "frozen_norm_epochs"),
    *(term.weight for term in TERMS),
    "false_alarms",
)
FRACTION_SETTINGS = (
    *("threshold", "flip_share", "mosaic_share", "blur_share", "colour", "noise"),
    *("distill_share", "grey_share", "hard_share", "init_share"),
)
LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(NON_NEGATIVE_SETTINGS, (0, MAX_SETTING)),
    **dict.fromkeys(FRACTION_SETTINGS, (0, 1)),
    **{"validation_share": (0, 0.5), "batch_size": (1, MAX_SETTING), "processes": (1, 256)},
    **{"paste": (0, 100), "seed": (0, 2**63 - 1)},
}
"""Bounds, which no real training exceeds. A recipe may come from a stranger, so it must not start
arbitrarily many processes, paste arbitrarily many patches, or overflow float32."""


def _raise_if(wrong: bool, why: str) -> None:
    if wrong:
        raise ValueError(why)
