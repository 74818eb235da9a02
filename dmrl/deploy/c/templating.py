"""C text from templates and arrays."""

import re
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import NDArray

from dmrl import __version__
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.guards.safe_names import plain

OTHER_FILES = ("main", "harness", "count")
"""Names of other C files in the same folder, which a network must not use."""
LONGEST_NAME = 40
WIDTH = 100


def fill(template: str, **values: object) -> str:
    """Fill in a template of ``templates/``: replace its ``$names``.

    Untrusted values must be numbers or pass through `dmrl.guards.safe_names.comment_safe`: a value
    becomes code, or could end a comment.

    Raises
    ------
    KeyError
        If a name has no value.
    """
    text = files("dmrl.deploy.c").joinpath("templates", template).read_text(encoding="utf-8")
    return Template(text).substitute(values)


def array(kind: str, name: str, values: NDArray[np.integer]) -> str:
    """Format the definition of a constant array.

    Raises
    ------
    TypeError
        If the values are not integers, since anything else could inject code.
    """
    if values.dtype.kind not in "iu":
        raise TypeError(f"{name} is of {values.dtype}, not of integers")
    words = [f"{v}," for v in values.ravel().tolist()]
    body = "\n".join(wrapped(words, "    "))
    return f"static const {kind} {name}[{values.size}] = {{\n{body}\n}};\n"


def wrapped(words: list[str], indent: str) -> list[str]:
    """Wrap words into lines of at most ``LINE_WIDTH`` characters."""
    lines, line = [], indent
    for word in words:
        if len(line) + len(word) > WIDTH:
            lines.append(line.rstrip())
            line = indent
        line += word + " "
    return [*lines, line.rstrip()]


def c_name(network: IntegerNetwork) -> str:
    """Return the file name and function prefix of a network's C, from its architecture.

    It has letters, digits and underscores only: dmrl-nano becomes dmrl_nano.
    """
    name = re.sub(r"[^a-z0-9]+", "_", network.architecture.lower()).strip("_")[:LONGEST_NAME]
    return name if name[:1].isalpha() and name not in OTHER_FILES else f"net_{name}".rstrip("_")


def names_of(network: IntegerNetwork) -> dict[str, str]:
    """Return the values that every template uses."""
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
