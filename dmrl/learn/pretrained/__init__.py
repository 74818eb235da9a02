"""Pretrained networks, each a run folder of ``dmrl train`` with a model card."""

from pathlib import Path

SHIPPED = Path(__file__).parent


def names() -> list[str]:
    """Return the names of the pretrained networks."""
    return sorted(card.parent.name for card in SHIPPED.glob("*/README.md"))


def resolved(model: Path) -> Path:
    """Return the path of a model: itself if it exists, else the pretrained network of this name.

    Parameters
    ----------
    model
        A path, or a name in `list_pretrained`. Anything else is returned unchanged, so that the
        function that opens it reports the error.
    """
    return SHIPPED / model if not model.exists() and str(model) in names() else model
