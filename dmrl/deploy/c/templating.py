"""Templates, and arrays of numbers, as C text."""

import re
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import NDArray

from dmrl import __version__
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.guards.safe_names import plain

OTHER_FILES = ("main", "harness", "count")
"""C files that stand beside the network's at one time or another."""
LONGEST_NAME = 40
WIDTH = 100


def fill(template: str, **values: object) -> str:
    """A file of ``templates/`` with its ``$names`` replaced.

    Raises
    ------
    KeyError
        If a name has no value.

    What comes from a file must be a number, or have gone through `dmrl.guards.safe_names.plain`: a value
    becomes code or ends a comment.
    """
    text = files("dmrl.deploy.c").joinpath("templates", template).read_text(encoding="utf-8")
    return Template(text).substitute(values)


def array(kind: str, name: str, values: NDArray[np.integer]) -> str:
    """Definition of a constant array.

    Raises
    ------
    TypeError
        If the values are no integers: whatever else they are must not become code.
    """
    if values.dtype.kind not in "iu":
        raise TypeError(f"{name} is of {values.dtype}, not of integers")
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


def c_name(network: IntegerNetwork) -> str:
    """Name of a network's C files, and prefix of their functions: that of its architecture.

    In letters, digits and underscores, as C wants it: dmrl-nano is dmrl_nano.
    """
    name = re.sub(r"[^a-z0-9]+", "_", network.architecture.lower()).strip("_")[:LONGEST_NAME]
    return name if name[:1].isalpha() and name not in OTHER_FILES else f"net_{name}".rstrip("_")


def names_of(network: IntegerNetwork) -> dict[str, str]:
    """What every template is told of a network."""
    name = c_name(network)
    return {
        "prefix": name,
        "PREFIX": name.upper(),
        "version": __version__,
        "description": (
            f"{plain(network.name)}: int8 network {plain(network.architecture)} for images of "
            f"{network.width_px} x {network.height_px} pixels, as portable C."
        ),
    }
