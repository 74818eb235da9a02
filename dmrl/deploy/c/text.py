"""Templates, and arrays of numbers, as C text."""

from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import NDArray

from dmrl import __version__
from dmrl.deploy.integer import IntegerNetwork

NAME = "locanet"
"""Of the C files, and prefix of their functions, whichever the network."""
WIDTH = 100


def fill(template: str, **values: object) -> str:
    """A file of ``templates/`` with its ``$names`` replaced.

    Raises
    ------
    KeyError
        If a name has no value.
    """
    text = files("dmrl.deploy.c").joinpath("templates", template).read_text(encoding="utf-8")
    return Template(text).substitute(values)


def array(kind: str, name: str, values: NDArray[np.integer]) -> str:
    """Definition of a constant array."""
    words = [f"{v}," for v in values.ravel().tolist()]
    body = "\n".join(wrapped(words, "    "))
    return f"static const {kind} {name}[{values.size}] = {{\n{body}\n}};\n"


def wrapped(words: list[str], indent: str) -> list[str]:
    """Words in lines of at most ``WIDTH`` characters."""
    lines, line = [], indent
    for word in words:
        if len(line) + len(word) > WIDTH:
            lines.append(line.rstrip())
            line = indent
        line += word + " "
    return [*lines, line.rstrip()]


def names_of(network: IntegerNetwork) -> dict[str, str]:
    """What every template is told of a network."""
    return {
        "prefix": NAME,
        "PREFIX": NAME.upper(),
        "version": __version__,
        "description": (
            f"{network.name}: int8 network {network.architecture} for images of "
            f"{network.width_px} x {network.height_px} pixels, as portable C."
        ),
    }
