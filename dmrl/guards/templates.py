"""Open folders of Jinja templates."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2


def open_templates(
    folder: Path, filters: Mapping[str, Callable[..., Any]], **options: Any
) -> jinja2.Environment:
    """Open a folder of templates in which a name without a value is an error.

    Parameters
    ----------
    folder
        Folder of the templates.
    filters
        Filters by name, in addition to those of Jinja.
    options
        Options of `jinja2.Environment`, such as its delimiters and ``autoescape``.
    """
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        **options,
    )
    templates.filters |= filters
    return templates
