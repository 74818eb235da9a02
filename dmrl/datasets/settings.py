"""What a person chooses of a dataset."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lt=1))]
Positive = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How recordings become a dataset.

    Parameters
    ----------
    labels
        Whose labels. "auto" takes, for each recording, the first of estimate, truth, hand and
        published that it has: what dmrl label made goes before the truth. "best" takes the truth
        before estimates.
    keep_all
        Use labels that are not OK as well. Without it, images with such a label are left out.
    split
        "auto": as the source says, where it does, else whole recordings. "recordings": whole
        recordings. "none": everything is train.
    test_share
        Share of the recordings that become the test split, 0 to 1.
    val
        Pattern of the recordings' names that become the split val, on which a training chooses its
        threshold and never learns, such as "held*". Empty: none.
    seed
        Another seed holds out other recordings.
    masks
        Keep the masks of rendered robots: a training can then paste robots without what was
        around them. Images that show a peer and have no mask are left out.
    png
        Store PNG images in place of raw pixels: less disk, but decoded at each opening.
    parquet
        Write Parquet files in place of Arrow shards: for publishing. Images are PNG then, which
        others show as images.
    without
        CSV file of images to leave out: source, robot, log_time. dmrl view DATASET --flag helps
        to write one.
    shard_images
        Images per shard, at most.
    title
        Name of the dataset on its card. Empty: made from the recordings' names.
    license
        License on the card: an SPDX identifier such as cc-by-4.0, or a word of the Hugging Face
        Hub's: unknown, other.
    """

    labels: Literal["auto", "best", "truth", "estimate", "hand", "published"] = "auto"
    keep_all: bool = False
    split: Literal["auto", "recordings", "none"] = "auto"
    test_share: Share = 0.2
    val: str = ""
    seed: int = 0
    masks: bool = False
    png: bool = False
    parquet: bool = False
    without: Path | None = None
    shard_images: Positive = 2048
    title: str = ""
    license: str = "unknown"
