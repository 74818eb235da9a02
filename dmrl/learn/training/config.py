"""Every setting of a training, with dmrl's own defaults."""

from dataclasses import dataclass, field
from typing import Literal

from dmrl.learn.data.augment import Augmentation
from dmrl.learn.data.crops import Intrinsics
from dmrl.learn.data.targets import LabelNoise
from dmrl.learn.networks.architectures import CLASS, SPREAD
from dmrl.learn.training.losses import TERMS, LossSettings
from dmrl.learn.training.optimizer import OptimizerName

DEFAULT, AUTO = "dmrl-nano", "auto"


@dataclass(frozen=True, slots=True)
class FitSettings(LossSettings):
    """How a network is trained; what is learnt stands in `LossSettings`.

    Parameters
    ----------
    architecture
        Name of the network. auto: that of the model to start from or, without one, dmrl-nano.
    epochs
        Times that ``epoch_images`` are seen.
    epoch_images
        Images of an epoch: a few come often, of many some. 0: as many as there are.
    batch_size
        Images per step.
    optimizer
        "muon": Muon for the kernels that mix channels, AdamW for the rest.
        "adam": Adam as published or, with a weight decay, AdamW.
    learning_rate
        Of the optimizer, at the end of the warm-up.
    final_learning_rate
        At the last step, after a half cosine.
    warmup_epochs
        Epochs over which the learning rate rises linearly from zero.
    weight_decay
        Decoupled, on convolution weights. 0 with "adam": plain Adam.
    ema_steps
        Steps over which the weights that are kept are averaged. 0: the last weights are kept.
    target_sigma_cells
        Width (one sigma) of a robot in the confidence targets, cells. 0: one cell, as
        published.
    distill_share
        With a teacher: how much of the losses is against what it says, the rest against the
        labels, 0 to 1.
    label_noise
        What the labels' sigmas do: "ignore" them, "weight" the cells, or "soften" the targets.
    shares
        How much of an epoch comes from which recordings: patterns of their names, as in
        { "flight-*" = 0.7, "renders*" = 0.3 }. Empty: every image once.
    validation_share
        Share of the training images held out, where the dataset has no split named val, to
        choose the threshold on. The last of each recording, so that neighbours in time stay
        together.
    threshold
        Confidence from which the model's detections are to be believed, 0 to 1. Without it,
        that of the best F1 on the images held out among those that keep to ``false_alarms``, or
        0.33 where these hold fewer than 10 robots.
    false_alarms
        Detections at or above the threshold in an image without a robot, on average, at most:
        of the images held out, where at least 20 of them have none.
    init_share
        Share of the weights that a training starts from in those that are kept, 0 to 1: what was
        known before is forgotten less (Wortsman et al. 2022). 0: the trained ones alone.
    hard_share
        Share of an epoch that is images without a robot, those first that the network believes
        to hold one: each as often as the square of its greatest confidence. They are looked at
        anew before every epoch. 0: as often as the other images.
    flip_share
        Share of windows mirrored left to right, 0 to 1.
    zoom
        Least and greatest magnification. Depth follows it, and stays among those of the labels.
    rotation_deg
        Greatest turn about the optical axis, either way.
    mosaic_share
        Share of images put together from windows of two or four, 0 to 1.
    paste
        Mean number of patches of other images pasted into one. Needs labels with boxes.
    plain_epochs
        The last epochs, in which images stay whole: mirrored and tinted, but not zoomed, turned
        or put together (Ge et al. 2021).
    frozen_norm_epochs
        The last epochs, in which batch normalisation takes its running statistics, as the
        network will when it is used, in place of each batch's.
    colour
        Spread (one sigma) of contrast, brightness and white balance, 0 to 1.
    noise
        Greatest sigma of sensor noise, 0 to 1 of full scale.
    blur_share
        Share of images slightly out of focus, 0 to 1.
    intrinsics
        fx, fy, cx and cy of the camera, pixels, of images without distortion. With them windows
        of images are what the camera would have seen had it been turned; without, they are cut
        out, and carry along the stretch of where they were.
    grey_share
        Share of images whose colours are taken away, 0 to 1, for grey cameras as well.
    precision
        What the network is trained in. "bfloat16": the body in bfloat16, weights, head and
        losses in float32; half as long again as fast on CPUs that have it.
    seed
        Of the first weights, the order of the images and their augmentation.
    device
        Where to compute; auto takes CUDA where there is one.
    processes
        That share every batch, on a CPU: one for each core is faster than one with as many
        threads. As many give the same weights, byte for byte. torchrun says how many itself.
    """

    architecture: str = DEFAULT
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
    false_alarms: float = 0.05
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
        for name in AT_LEAST_ONE:
            _refuse(getattr(self, name) < 1, f"{name}: must be at least 1")
        falls = 0 <= self.final_learning_rate <= self.learning_rate
        _refuse(
            self.learning_rate <= 0 or not falls,
            "learning_rate: must be over 0 and not below final_learning_rate",
        )
        for name in NOT_NEGATIVE:
            _refuse(getattr(self, name) < 0, f"{name}: must not be negative")
        for name, most in MOST.items():
            _refuse(getattr(self, name) > most, f"{name}: must be at most {most}")
        for name in SHARES:
            value = getattr(self, name)
            _refuse(value is not None and not 0 <= value <= 1, f"{name}: must be between 0 and 1")
        _refuse(self.validation_share > 0.5, "validation_share: must be at most 0.5")
        least, greatest = self.zoom
        _refuse(not 0 < least <= greatest, "zoom: must be over 0, the lesser first")
        focal_px = self.intrinsics[:2] if self.intrinsics else (1.0,)
        _refuse(min(focal_px) <= 0, "intrinsics: fx and fy must be over 0")
        wide = max(map(abs, self.intrinsics or (0.0,))) > LARGE
        _refuse(wide, f"intrinsics: must be at most {LARGE}")
        beyond = any(not 0 <= share <= LARGE for share in self.shares.values())
        _refuse(beyond, f"shares: must be between 0 and {LARGE}")

    @property
    def extra(self) -> tuple[str, ...]:
        """Channels of the network on top of its architecture's own."""
        classes = tuple(f"{CLASS}{k}" for k in range(len(self.classes)))
        return (*([SPREAD] if self.spread_weight else []), *classes)

    def augmentation(self, epoch: int) -> Augmentation:
        """How images are varied in an epoch, from 0."""
        whole = Augmentation(
            self.flip_share,
            self.zoom,
            self.rotation_deg,
            self.mosaic_share,
            self.paste,
            self.colour,
            self.noise,
            self.blur_share,
            self.intrinsics,
            self.grey_share,
        )
        return whole if epoch < self.epochs - self.plain_epochs else whole.plain


SHARES = (
    *("validation_share", "threshold", "flip_share", "mosaic_share"),
    *("blur_share", "colour", "noise", "distill_share", "grey_share", "hard_share"),
    "init_share",
)
AT_LEAST_ONE = ("epochs", "batch_size", "processes")
NOT_NEGATIVE = (
    "epoch_images",
    *("warmup_epochs", "weight_decay", "ema_steps", "target_sigma_cells", "focus", "seed"),
    *(term.weight for term in TERMS),
    *("rotation_deg", "paste"),
    *("plain_epochs", "frozen_norm_epochs", "false_alarms"),
)
LARGE = 10_000_000
MOST = dict.fromkeys(("learning_rate", *AT_LEAST_ONE, *NOT_NEGATIVE), LARGE) | {
    "processes": 256,
    "paste": 100,
    "seed": 2**63 - 1,
}
"""What no training reaches: a recipe may come from a stranger, and asks for no more processes,
pictures or peers in one, and for no number that float32 cannot hold."""


def _refuse(wrong: bool, why: str) -> None:
    if wrong:
        raise ValueError(why)
