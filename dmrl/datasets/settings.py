"""Settings of ``dmrl dataset``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lt=1))]
Positive = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings that turn recordings into a dataset.

    Parameters
    ----------
    labels
        Source of the labels. "auto" takes, for each recording, the first of estimate, truth, hand
        and published that it has: labels from dmrl label go before the truth. "best" takes the
        truth before estimates.
    keep_all
        Also use labels that are not OK. Without it, images with such a label are left out.
    split
        "auto": the split that the source defines, else whole recordings. "recordings": whole
        recordings. "none": everything is train.
    test_share
        Share of the recordings that become the test split, 0 to 1.
    val
        Pattern of the names of recordings that become the split val, such as "held*". A training
        chooses its threshold on it and never learns from it. Empty: none.
    seed
        Another seed holds out other recordings.
    masks
        Keep the masks of rendered robots. A training can then paste robots without their
        surroundings. Images that show a peer and have no mask are left out.
    pixels
        Storage of the images. "raw": pixels, mapped into memory without decoding. "png": smaller,
        decoded at each use. "jpeg": the recorded JPEG bytes unchanged, and PNG for other images:
        the smallest, decoded at each use.
    png
        The same as --pixels png.
    parquet
        Write Parquet files in place of Arrow shards, for publishing. Images are packed then, as PNG
        unless --pixels jpeg is given; other tools display them.
    corrections
        Recordings of corrected labels, as the page of dmrl view --flag saves them: of their images,
        these labels are used. Repeat for more.
    without
        CSV file of images to leave out: source, robot, log_time. dmrl view DATASET --flag helps
        to write one.
    shard_images
        Images per shard, at most.
    title
        Name of the dataset on its card. Empty: made from the names of the recordings.
    license
        License on the card: an SPDX identifier such as cc-by-4.0, or one of the Hugging Face
        Hub's names: unknown, other.
    """

    labels: Literal["auto", "best", "truth", "estimate", "hand", "published"] = "auto"
    keep_all: bool = False
    split: Literal["auto", "recordings", "none"] = "auto"
    test_share: Share = 0.2
    val: str = ""
    seed: int = 0
    masks: bool = False
    pixels: Literal["raw", "png", "jpeg"] = "raw"
    png: bool = False
    parquet: bool = False
    without: Path | None = None
    corrections: Annotated[tuple[Path, ...], Parameter(negative=(), show_default=False)] = ()
    shard_images: Positive = 2048
    title: str = ""
    license: str = "unknown"
