"""Float ONNX of a model, made once: later runs need neither torch nor onnx.

The files lie in the user's cache folder, named by a hash of the weights, of the description and of
the code that makes ONNX of them. Networks of plug-ins are made anew each time.
"""

import hashlib
import json
import os
from contextlib import suppress
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from dmrl import entry_points
from dmrl.atomic_output import replace_file
from dmrl.errors import OutputError, optional_imports
from dmrl.guards.bounded_parsing import parse_json
from dmrl.learn.pretrained import DESCRIPTION_NAME, WEIGHTS_NAME

CODE = (
    *("deploy/int8/graph.py", "deploy/onnx/float_model.py", "deploy/onnx/graph_writer.py"),
    *("learn/networks/architectures.py", "learn/networks/keras_weights.py"),
    *("learn/networks/trace.py", "learn/inference/loaded_model.py"),
)
"""Files whose change makes other ONNX of the same weights."""
KEPT = 20
"""Models that the cache keeps, some 100 kB each. The ones made first go first."""


def build_float_onnx_once(model: Path, *, grey: bool) -> tuple[bytes, dict[str, Any]]:
    """Return the float ONNX of a model, and the description that an export has beside it.

    Raises
    ------
    ModelError
        If the model cannot be used, or has a layer that cannot be carried.
    MissingExtra
        If it has to be made, and torch or onnx is not installed.
    """
    if model.is_dir():
        weights, description = model / WEIGHTS_NAME, model / DESCRIPTION_NAME
    else:
        weights, description = model, model.with_suffix(".json")
    key = _hash_inputs([weights, description], grey=grey)
    cached = _cache_folder() / f"{key}.onnx"
    with suppress(OSError, ValueError):
        return cached.read_bytes(), parse_json(cached.with_suffix(".json").read_text("utf-8"))
    with optional_imports("train", "a model to ONNX"):
        trained = import_module("dmrl.learn.inference.loaded_model")
        exporter = import_module("dmrl.deploy.onnx.float_model")
    loaded = trained.load_model(model)
    made, said = exporter.float_onnx_of(loaded, grey=grey), trained.describe(loaded)
    if said["architecture"] not in entry_points.find_plugins(entry_points.NETWORKS):
        with suppress(OSError, OutputError):  # a home that cannot be written: made again each time
            cached.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(cached.with_suffix(".json")) as partial:
                partial.write_text(json.dumps(said), encoding="utf-8")
            with replace_file(cached) as partial:
                partial.write_bytes(made)
            _remove_oldest(cached.parent)
    return made, said


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dmrl" / "onnx"


def _remove_oldest(folder: Path) -> None:
    """Remove all models but the newest of the cache."""
    for old in sorted(folder.glob("*.onnx"), key=lambda path: path.stat().st_mtime)[:-KEPT]:
        for path in (old, old.with_suffix(".json")):
            path.unlink(missing_ok=True)


def _hash_inputs(paths: list[Path], *, grey: bool) -> str:
    """Return a hash of files, of those that exist, and of the code that reads them."""
    total = hashlib.sha256(b"grey" if grey else b"")
    for data in [path.read_bytes() for path in paths if path.is_file()]:
        total.update(len(data).to_bytes(8, "little") + data)
    for name in CODE:
        total.update(files("dmrl").joinpath(name).read_bytes())
    return total.hexdigest()[:32]
