"""Trained models: run folders, safetensors files and published Keras .h5 files.

A run folder contains ``model.safetensors`` and ``model.json``. Nothing is ever unpickled.
"""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from dmrl.errors import ModelError
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.paths import refuse_pipes, require_text_path
from dmrl.learn import pretrained
from dmrl.learn.inference.decode_grids import Grids, require_whole_cells
from dmrl.learn.networks.architectures import (
    CLASS_PREFIX,
    SPREAD_CHANNEL,
    Network,
    build_network,
    count_parameters,
    find_architecture,
    list_architectures,
    normalize_images,
    unbind_channels,
)
from dmrl.learn.networks.keras_weights import load_keras_weights
from dmrl.learn.pretrained import DESCRIPTION_NAME, WEIGHTS_NAME

PUBLISHED_THRESHOLD = 0.33
"""Confidence threshold of the published evaluation, 0 to 1."""


def predict_grids(network: Network, images: Tensor) -> Grids:
    """Run a network, in its present mode and on its device, on (N, 3, H, W) uint8 images."""
    device = next(network.parameters()).device
    with torch.inference_mode():
        out = network(normalize_images(images.to(device))).cpu()
    named = unbind_channels(network.channels, out)
    classes = [named[name] for name in network.channels if name.startswith(CLASS_PREFIX)]
    return Grids(
        named["confidence"].sigmoid().numpy(),
        named["log_depth"].exp().numpy(),
        np.stack([named["offset_u"], named["offset_v"]], axis=1) if "offset_u" in named else None,
        named[SPREAD_CHANNEL].exp().numpy() if SPREAD_CHANNEL in named else None,
        torch.stack(classes).argmax(dim=0).numpy() if classes else None,
    )


@dataclass(frozen=True, slots=True)
class Model:
    """A network and its description.

    Parameters
    ----------
    network
        Network in evaluation mode.
    architecture
        Name of the architecture, one of `list_architectures`.
    name
        Name of the file or folder it was loaded from.
    width_px, height_px
        Size of the images it was trained on.
    threshold
        Confidence from which a detection is reported, 0 to 1.
    label_source
        Source of the labels it was trained on ("truth", "published", ...); empty: unknown.
    training
        Summary of the training: settings, losses, images.
    rates
        How often it detects and errs, as of `measure_rates`. None: not measured.
    focal_px
        Focal lengths of the cameras it was trained with, pixels, the main one first. Empty:
        unknown.
    """

    network: Network
    architecture: str
    name: str = ""
    width_px: int = 320
    height_px: int = 224
    threshold: float = PUBLISHED_THRESHOLD
    label_source: str = ""
    training: dict[str, Any] = field(default_factory=dict)
    rates: dict[str, Any] | None = None
    focal_px: list[float] = field(default_factory=list)

    def require_size(self, width_px: int, height_px: int, what: object) -> None:
        """Raise SettingError unless the network accepts images of this size.

        Raises
        ------
        SettingError
            If a side is not a whole number of grid cells.
        """
        cell_px = self.network.stride_px
        require_whole_cells((width_px, height_px), cell_px, self.architecture, what)

    def grids(self, images: NDArray[np.uint8]) -> Grids:
        """Run the network on (N, H, W, 3) RGB images.

        Raises
        ------
        SettingError
            If the network does not accept images of this size.
        """
        self.require_size(images.shape[2], images.shape[1], self.name or self.architecture)
        # torch accepts writable arrays only; a view of a mapped file is copied here.
        writable = np.require(images, requirements="W")
        return predict_grids(self.network, torch.from_numpy(writable).permute(0, 3, 1, 2))


def get_weights(network: Network) -> dict[str, Tensor]:
    """Return every tensor of a network, contiguous, on the CPU.

    Batch counters are left out: normalisations with fixed momentum do not use them.
    """
    return {
        name: value.detach().cpu().contiguous()
        for name, value in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }


def interpolate_weights(network: Network, first: dict[str, Tensor], share: float) -> None:
    """Interpolate a network's weights linearly towards others, in place.

    Parameters
    ----------
    network
        Network, changed in place.
    first
        Other weights, with the names and shapes of `get_weights`.
    share
        Weight of ``first``. 0: no change; 1: all weights are replaced.
    """
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if name in first and value.is_floating_point():
                value.lerp_(first[name].to(value.device), share)


def transfer_weights(known: Network, network: Network) -> dict[str, Tensor]:
    """Return weights of one network for another with the same body and perhaps other channels.

    Channels that only the second network has keep its present weights.
    """
    weights, fresh = get_weights(known), get_weights(network)
    for name in ("head.weight", "head.bias"):
        if known.channels == network.channels or name not in weights:
            continue
        rows = fresh[name].clone()
        for k, channel in enumerate(network.channels):
            if channel in known.channels:
                rows[k] = weights[name][known.channels.index(channel)]
        weights[name] = rows
    return weights


def assign_weights(network: Network, weights: dict[str, Tensor], where: object) -> None:
    """Copy weights into a network.

    Raises
    ------
    ModelError
        If a tensor is missing, unknown, not finite or of another shape.
    """
    wanted = get_weights(network)
    if odd := sorted(wanted.keys() ^ weights.keys()):
        verb = "lacks" if odd[0] in wanted else "has an unknown"
        raise ModelError(f"{where} {verb} tensor {odd[0]}. Use weights of this architecture")
    for name, value in weights.items():
        if value.dtype not in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
            raise ModelError(f"{where}: {name} holds {value.dtype}. Give weights in float32")
        if value.shape != wanted[name].shape:
            raise ModelError(
                f"{where}: {name} has shape {tuple(value.shape)}, the network needs "
                f"{tuple(wanted[name].shape)}. Use weights of this architecture"
            )
        if not torch.isfinite(value).all():
            raise ModelError(f"{where}: {name} holds values that are not finite. Train again")
    network.load_state_dict(weights, strict=False)


def write_tensors(tensors: dict[str, Tensor], path: Path) -> None:
    """Write a .safetensors file.

    A full disk raises OSError, unlike with the library's own writer.
    """
    path.write_bytes(save(tensors))


def describe(model: Model) -> dict[str, Any]:
    """Return the content of ``model.json``."""
    return {
        "architecture": model.architecture,
        "parameters": count_parameters(model.network),
        "width_px": model.width_px,
        "height_px": model.height_px,
        "stride_px": model.network.stride_px,
        "focal_px": model.focal_px,
        "channels": 3,
        "outputs": list(model.network.channels),
        "threshold": model.threshold,
        "label_source": model.label_source,
        "rates": model.rates,
        "training": model.training,
    }


def save_model(model: Model, folder: Path) -> None:
    """Write ``model.safetensors`` and ``model.json`` into a folder."""
    write_tensors(get_weights(model.network), folder / WEIGHTS_NAME)
    text = json.dumps(describe(model), indent=1) + "\n"
    (folder / DESCRIPTION_NAME).write_text(text, encoding="utf-8")


def load_model(path: Path) -> Model:
    """Load a model from a run folder, a .safetensors with its .json, or a Keras .h5.

    The format is detected by content, not by name.

    Raises
    ------
    ModelError
        If the file has none of these formats, is damaged, or its tensors do not fit the
        architecture. A pickle is rejected without reading it.
    """
    require_text_path(path)
    refuse_pipes(path)
    if path.is_dir():
        return _load_safetensors(path / WEIGHTS_NAME, path / DESCRIPTION_NAME, path.name)
    if not path.is_file():
        raise ModelError(
            f"no model {path}. Give a run folder, a .safetensors, a Keras .h5, or the name of one "
            f"that ships with dmrl: {', '.join(pretrained.list_pretrained())}"
        )
    with path.open("rb") as stream:
        head = stream.read(16)
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        network = build_network("locanet")
        assign_weights(network, load_keras_weights(path), path)
        return Model(network.eval(), "locanet", path.name)
    if head[4:9] != b"\0\0\0\0{":
        if head.startswith((b"PK\x03\x04", b"\x80")):
            raise ModelError(
                f"{path} is a pickle, which can run any code when it is opened, so it is not. "
                "Give a run folder, a .safetensors or a Keras .h5"
            )
        raise ModelError(f"{path} is not a model. Give a run folder, a .safetensors or a Keras .h5")
    return _load_safetensors(path, path.with_suffix(".json"), path.name)


def _load_safetensors(weights: Path, description: Path, name: str) -> Model:
    for file in (weights, description):
        if not file.is_file():
            raise ModelError(f"no {file.name} in {file.parent}. Give a run folder of dmrl train")
    said = _load_description(description)
    network = build_network(said["architecture"], extra=_extra_channels(said, description))
    try:
        tensors = load_file(weights)
    except (SafetensorError, OSError) as e:
        raise ModelError(f"{weights} is damaged: {e}. Copy it again or train again") from None
    assign_weights(network, tensors, weights)
    known = ("width_px", "height_px", "threshold", "label_source", "training")
    fields = {k: said[k] for k in known} | {"rates": said.get("rates")}
    fields["focal_px"] = said.get("focal_px", [])
    return Model(network.eval(), said["architecture"], name, **fields)


def _extra_channels(said: dict[str, Any], path: Path) -> list[str]:
    """Return the channels of a description in addition to the architecture's own."""
    own = list(find_architecture(said["architecture"]).own)
    outputs = said.get("outputs", own)
    extra = outputs[len(own) :] if isinstance(outputs, list) else None
    wanted = [name for name in extra or [] if name == SPREAD_CHANNEL]
    wanted += [f"{CLASS_PREFIX}{k}" for k in range(len(extra or []) - len(wanted))]
    if extra is None or outputs != own + wanted:
        raise ModelError(f"{path} has no valid outputs. Give the model.json of dmrl train")
    return wanted


def _load_description(path: Path) -> dict[str, Any]:
    kinds: dict[str, type | tuple[type, ...]] = {
        "architecture": str,
        "width_px": int,
        "height_px": int,
        "threshold": (int, float),
        "label_source": str,
        "training": dict,
    }
    try:
        said = parse_json(path.read_text(encoding="utf-8"))
    except ValueError as e:
        raise ModelError(f"{path} is not JSON: {e}. Copy it again") from None
    for key, kind in kinds.items():
        if not isinstance(said, dict) or not isinstance(said.get(key), kind):
            raise ModelError(f"{path} has no valid {key}. Give the model.json of dmrl train")
    if not 0 < said["width_px"] * said["height_px"] <= limits.PIXELS or said["width_px"] < 0:
        size = f"{said['width_px']} x {said['height_px']}"
        raise ModelError(f"{path} is for images of {size}. Give the model.json of dmrl train")
    if not math.isfinite(said["threshold"]):
        raise ModelError(f"{path} has no valid threshold. Give the model.json of dmrl train")
    if said["architecture"] not in list_architectures():
        raise ModelError(
            f"{path} requires architecture {said['architecture']}, this dmrl has "
            f"{', '.join(list_architectures())}. Update dmrl, or install the package with it"
        )
    return dict(said)
