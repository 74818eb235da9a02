"""C text from templates and arrays."""

import re
import textwrap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl import __version__
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.guards.safe_names import comment_safe
from dmrl.guards.templates import open_templates

RESERVED_FILE_NAMES = ("main", "harness", "count")
"""Names of other C files in the same folder, which a network must not use."""
MAX_NAME_LENGTH = 40
LINE_WIDTH = 100
INDENT = "    "


def fill_template(template: str, **values: object) -> str:
    """Fill in a template of ``templates/``: Jinja with ``${...}`` and ``/*% ... %*/``.

    Untrusted values must be numbers or pass through `dmrl.guards.safe_names.comment_safe`: a value
    becomes code, or could end a comment.

    Raises
    ------
    jinja2.UndefinedError
        If a name has no value.
    """
    return _TEMPLATES.get_template(template).render(values)


def format_numbers(values: NDArray[np.integer]) -> str:
    """Format the numbers of a constant array, in lines of at most ``LINE_WIDTH`` characters.

    Raises
    ------
    TypeError
        If the values are not integers, since anything else could inject code.
    """
    if values.dtype.kind not in "iu":
        raise TypeError(f"an array is of {values.dtype}, not of integers")
    text = " ".join(f"{value}," for value in values.ravel().tolist())
    return textwrap.fill(
        text, LINE_WIDTH, initial_indent=INDENT, subsequent_indent=INDENT, break_on_hyphens=False
    )


_TEMPLATES = open_templates(
    Path(__file__).parent / "templates",
    {"wrapped": format_numbers},
    keep_trailing_newline=True,
    block_start_string="/*%",
    block_end_string="%*/",
    variable_start_string="${",
    variable_end_string="}",
    comment_start_string="/*#",
    comment_end_string="#*/",
)
_TEMPLATES.globals["zip"] = zip


def c_name(network: IntegerNetwork) -> str:
    """Return the file name and function prefix of a network's C, from its architecture.

    It has letters, digits and underscores only: dmrl-nano becomes dmrl_nano.
    """
    name = re.sub(r"[^a-z0-9]+", "_", network.architecture.lower()).strip("_")[:MAX_NAME_LENGTH]
    good = name[:1].isalpha() and name not in RESERVED_FILE_NAMES
    return name if good else f"net_{name}".rstrip("_")


def template_values(network: IntegerNetwork) -> dict[str, str]:
    """Return the values that every template uses."""
    name = c_name(network)
    return {
        "prefix": name,
        "PREFIX": name.upper(),
        "version": __version__,
        "description": (
            f"{comment_safe(network.name)}: int8 network {comment_safe(network.architecture)} for "
            f"images of {network.width_px} x {network.height_px} pixels, as portable C."
        ),
    }
