"""Checkpoints: weights and optimizer state at the end of an epoch, for resuming a training.

Tensors are in a safetensors file named after the epoch; ``checkpoint.json`` names that file. The
JSON is replaced atomically after the tensors are written, so it never names an incomplete file.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.optim import Optimizer

from dmrl.errors import ModelError, SettingError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.safe_names import safe_join
from dmrl.learn.inference.loaded_model import assign_weights, get_weights, write_tensors
from dmrl.learn.networks.architectures import Network

CHECKPOINT_NAME = "checkpoint.json"


@dataclass(frozen=True, slots=True)
class TrainingProgress:
    """Progress of a training.

    Parameters
    ----------
    run
        Settings and identity of the data. A training resumes only if these are equal.
    epochs_done
        Number of completed epochs.
    history
        Mean losses of each epoch.
    """

    run: dict[str, Any]
    epochs_done: int = 0
    history: list[dict[str, float]] = field(default_factory=list)


def has_checkpoint(folder: Path) -> bool:
    """Return whether the folder contains a checkpoint."""
    return (folder / CHECKPOINT_NAME).is_file()


def save_checkpoint(
    folder: Path, networks: Mapping[str, Network], optimizer: Optimizer, state: TrainingProgress
) -> None:
    """Write a checkpoint; the previous one remains until this one is complete."""
    tensors = {
        f"{role}.{name}": value
        for role, network in networks.items()
        for name, value in get_weights(network).items()
    }
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            tensors[f"optimizer.{index}.{name}"] = value.detach().cpu().contiguous()
    name = f"checkpoint-{state.epochs_done:04d}.safetensors"
    write_tensors(tensors, folder / name)
    unfinished = folder / f"{CHECKPOINT_NAME}.partial"
    document = {**asdict(state), "tensors": name}
    unfinished.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(folder / CHECKPOINT_NAME)
    for old in folder.glob("checkpoint-*.safetensors"):
        if old.name != name:
            old.unlink()


def load_checkpoint(
    folder: Path, networks: Mapping[str, Network], optimizer: Optimizer, run: dict[str, Any]
) -> TrainingProgress:
    """Load a checkpoint into the networks (by role) and the optimizer, and return its progress.

    Raises
    ------
    ModelError
        If the folder has no complete checkpoint.
    SettingError
        If the checkpoint belongs to a training with other settings or data.
    """
    if not has_checkpoint(folder):
        raise ModelError(f"no checkpoint in {folder} to resume from. Train without --resume")
    try:
        said = parse_json((folder / CHECKPOINT_NAME).read_text(encoding="utf-8"))
        tensors = load_file(safe_join(folder, said.pop("tensors"), f"{folder}: the tensors"))
        state = TrainingProgress(**said)
        if not isinstance(state.run, dict) or not isinstance(state.epochs_done, int):
            raise ValueError("run or epochs_done is missing")
        _require_same_run(state.run, run, folder)
        for role, network in networks.items():
            start = f"{role}."
            mine = {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}
            assign_weights(network, mine, folder)
        _load_optimizer_state(optimizer, tensors)
    except (ValueError, LookupError, TypeError, RuntimeError, OSError, SafetensorError) as e:
        raise ModelError(
            f"{folder}/{CHECKPOINT_NAME} is damaged: {e}. Train without --resume"
        ) from None
    return state


def _require_same_run(before: dict[str, Any], now: dict[str, Any], folder: Path) -> None:
    """Raise SettingError unless two trainings have the same settings and data."""
    now = json.loads(json.dumps(now))
    different = sorted(k for k in before.keys() | now.keys() if before.get(k) != now.get(k))
    if different:
        key = different[0]
        raise SettingError(
            f"{folder} was trained with {key} {before.get(key)}, not {now.get(key)}. "
            "Resume with the settings and data it was started with, or train without --resume"
        )


def _load_optimizer_state(optimizer: Optimizer, tensors: dict[str, Tensor]) -> None:
    """Load the optimizer's state from the tensors of a checkpoint."""
    fresh = optimizer.state_dict()
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {i: {} for i in range(len(parameters))}
    for key, value in tensors.items():
        if key.startswith("optimizer."):
            _, index, name = key.split(".")
            like = parameters[int(index)]
            # Keep the memory format of the parameter: another one may round differently.
            state[int(index)][name] = (
                torch.empty_like(like).copy_(value) if value.shape == like.shape else value
            )
    optimizer.load_state_dict({"state": state, "param_groups": fresh["param_groups"]})


def remove_checkpoint(folder: Path) -> None:
    """Remove the checkpoint from a folder whose training has finished."""
    for path in (folder / CHECKPOINT_NAME, *folder.glob("checkpoint-*.safetensors")):
        path.unlink(missing_ok=True)
