"""Networks that ship with dmrl: each a run folder of ``dmrl train`` with a card, by its name."""

from pathlib import Path

SHIPPED = Path(__file__).parent


def names() -> list[str]:
    """Names of the networks that ship with dmrl."""
    return sorted(card.parent.name for card in SHIPPED.glob("*/README.md"))


def resolved(model: Path) -> Path:
    """The model itself where there is one, else the network that ships under this name.

    Parameters
    ----------
    model
        A path, or a name in ``names()``. A path that is neither is given back: what opens it
        says what is wrong.
    """
    return SHIPPED / model if not model.exists() and str(model) in names() else model
