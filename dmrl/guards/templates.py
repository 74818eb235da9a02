"""Open folders of Jinja templates."""

from pathlib import Path
from typing import Any

import jinja2


def open_templates(folder: Path, **options: Any) -> jinja2.Environment:
    """Open a folder of templates in which a name without a value is an error.

    Parameters
    ----------
    folder
        Folder of the templates.
    options
        Options of `jinja2.Environment`, such as its delimiters and ``autoescape``.
    """
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        **options,
    )
