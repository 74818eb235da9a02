"""Fill in the templates of a card."""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import jinja2

from dmrl.guards.safe_names import escape_markdown, markdown_code
from dmrl.guards.templates import open_templates

MAX_NAMES_ON_A_LINE = 3
"""Names on a line, at most."""


def fill_template(template: str, **values: object) -> str:
    """Fill in a template of ``templates/``.

    A text from a file passes through one of the filters ``text``, ``code``, ``names``, ``json``.
    """
    return _environment().get_template(template).render(values)


@cache
def _environment() -> jinja2.Environment:
    folder = Path(__file__).parent / "templates"
    environment = open_templates(folder, keep_trailing_newline=True, autoescape=False)
    environment.filters |= {"text": escape_markdown, "code": markdown_code, "names": _join_names}
    environment.filters["bibtex"] = lambda text: "".join(c for c in text if c not in "{}\\")
    environment.filters |= {
        "repr": repr,
        "json": lambda value: json.dumps(value, ensure_ascii=False),
    }
    return environment


def _join_names(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES_ON_A_LINE
    known = ", ".join(map(markdown_code, names[:MAX_NAMES_ON_A_LINE]))
    return f"{known} and {more} more" if more > 0 else known
