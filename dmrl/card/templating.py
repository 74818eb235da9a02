"""Fill in the templates of a card."""

import json
from collections.abc import Sequence
from pathlib import Path

from dmrl.guards.safe_names import escape_markdown, markdown_code
from dmrl.guards.templates import open_templates

MAX_NAMES_ON_A_LINE = 3
"""Names on a line, at most."""


def fill_template(template: str, **values: object) -> str:
    """Fill in a template of ``templates/``.

    A text from a file passes through one of the filters ``text``, ``code``, ``names``, ``json``.
    """
    return _TEMPLATES.get_template(template).render(values)


def _join_names(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES_ON_A_LINE
    known = ", ".join(map(markdown_code, names[:MAX_NAMES_ON_A_LINE]))
    return f"{known} and {more} more" if more > 0 else known


_TEMPLATES = open_templates(
    Path(__file__).parent / "templates",
    {
        "text": escape_markdown,
        "code": markdown_code,
        "names": _join_names,
        "bibtex": lambda text: "".join(c for c in text if c not in "{}\\"),
        "repr": repr,
        "json": lambda value: json.dumps(value, ensure_ascii=False),
    },
    keep_trailing_newline=True,
)
