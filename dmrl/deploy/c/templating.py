"""C text from templates and arrays."""

import re
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import NDArray

from dmrl import __version__
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.guards.safe_names import comment_safe

RESERVED_FILE_NAMES = ("main", "harness", "count")
"""Names of other C files in the same folder, which a network must not use."""
MAX_NAME_LENGTH = 40
LINE_WIDTH = 100


def fill_template(template: str, **values: object) -> str:
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


def format_array(kind: str, name: str, values: NDArray[np.integer]) -> str:
    """Format the definition of a constant array.

    Raises
    ------
    TypeError
        If the values are not integers, since anything else could inject code.
    """
    if values.dtype.kind not in "iu":
        raise TypeError(f"{name} is of {values.dtype}, not of integers")
    words = [f"{v}," for v in values.ravel().tolist()]
    body = "\n".join(wrap_words(words, "    "))
    return f"static const {kind} {name}[{values.size}] = {{\n{body}\n}};\n"


def wrap_words(words: list[str], indent: str) -> list[str]:
    """Wrap words into lines of at most ``LINE_WIDTH`` characters."""
    lines, line = [], indent
    for word in words:
        if len(line) + len(word) > LINE_WIDTH:
            lines.append(line.rstrip())
            line = indent
        line += word + " "
    return [*lines, line.rstrip()]


def c_name(network: IntegerNetwork) -> str:
    """Return the file name and function prefix of a network's C, from its architecture.

    It has letters, digits and underscores only: dmrl-nano becomes dmrl_nano.
    """
    name = re.sub(r"[^a-z0-9]+", "_", network.architecture.lower()).strip("_")[:MAX_NAME_LENGTH]
    return (
        name
        if name[:1].isalpha() and name not in RESERVED_FILE_NAMES
        else f"net_{name}".rstrip("_")
    )


def template_values(network: IntegerNetwork) -> dict[str, str]:
    """Return the values that every template uses."""
    name = c_name(network)
    return {
        "prefix": name,
        "PREFIX": name.upper(),
        "version": __version__,
        "description": (
            f"{comment_safe(network.name)}: int8 network {comment_safe(network.architecture)} for "
            "images of "
            f"{network.width_px} x {network.height_px} pixels, as portable C."
        ),
    }
