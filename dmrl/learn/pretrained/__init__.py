"""Pretrained networks, each a run folder of ``dmrl train`` with a model card."""

from pathlib import Path

PRETRAINED_DIR = Path(__file__).parent
WEIGHTS_NAME = "model.safetensors"
DESCRIPTION_NAME = "model.json"
"""Files of a run folder."""


def list_pretrained() -> list[str]:
    """Return the names of the pretrained networks."""
    return sorted(card.parent.name for card in PRETRAINED_DIR.glob("*/README.md"))


def resolve_model_path(model: Path) -> Path:
    """Return the path of a model: itself if it exists, else the pretrained network of this name.

    Parameters
    ----------
    model
        A path, or a name in `list_pretrained`. Anything else is returned unchanged, so that the
        function that opens it reports the error.
    """
    ships = not model.exists() and str(model) in list_pretrained()
    return PRETRAINED_DIR / model if ships else model
