"""Blocks of a page, and one self-contained HTML file of them: no requests, no scripts.

Templates escape all text of blocks; a figure's SVG is code of this package.
"""

import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, ClassVar

from markupsafe import Markup

from dmrl.errors import DmrlError
from dmrl.guards import limits
from dmrl.guards.templates import open_templates
from dmrl.images.codec import crop_and_scale, decode, encode_jpeg
from dmrl.terminal.tables import to_cell_text

REPORT_MARK = "<!-- written by dmrl report -->"
"""Comment in every report: a file with it may be replaced."""
MAX_PAGE_BYTES = 9_000_000
"""Size of a page with its images, at most."""
INVALID_DATA_ERRORS = (
    *(DmrlError, OSError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError),
    StopIteration,
)
"""Errors that an invalid document or recording of another program may raise."""
MAX_PLAIN_PNG_BYTES, MAX_IMAGE_WIDTH_PX = 250_000, 1400


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading inside a section."""

    kind: ClassVar[str] = "heading"
    words: str


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph, and optionally code at its end."""

    kind: ClassVar[str] = "text"
    words: str
    code: str = ""


NUMBER = re.compile(r"(< )?[-+]?\d[\d.,]*%?(?=\s|$)")
"""Start of a cell with a number, such as ``0.71 (0.6, 0.9)`` or ``< -1``; a name such as 2026-11/a
is none."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table; columns of numbers, or of texts that begin with one, are right-aligned."""

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Iterable[Sequence[Any]]

    @property
    def cells(self) -> list[list[str]]:
        """Texts of the cells."""
        return [[_join_interval(to_cell_text(cell)) for cell in row] for row in self.rows]

    @property
    def kinds(self) -> list[str]:
        """Class of each column: n for numbers."""
        rows = self.cells
        number = [
            bool(rows) and all(NUMBER.match(row[k]) or row[k] in ("", "-") for row in rows)
            for k in range(len(self.columns))
        ]
        return ["n" if n else "" for n in number]


@dataclass(frozen=True, slots=True)
class Figure:
    """An SVG or an image with a caption; or the reason why there is none."""

    caption: str
    svg: str = ""
    image: str = ""
    failure: str = ""
    full: bool = False


@dataclass(frozen=True, slots=True)
class Row:
    """Figures beside each other, as far as the page is wide enough."""

    kind: ClassVar[str] = "row"
    figures: Sequence[Figure]


Block = Heading | Text | Table | Row
Documents = Mapping[str, Mapping[str, Any]]


def _join_interval(text: str) -> str:
    """Return a text whose interval in brackets breaks before it, not inside."""
    return re.sub(r"\[[^\]]*\]", lambda found: found[0].replace(" ", "\u00a0"), text)


def _escape_line(value: object) -> Markup:
    """Escape one line of text, also for an attribute in double quotes."""
    return Markup(escape(to_cell_text(value), quote=False).replace('"', "&quot;"))


def fill_template(template: str, **values: object) -> str:
    """Fill in a template of ``templates/``, which escapes all texts."""
    return _TEMPLATES.get_template(template).render(values)


_TEMPLATES = open_templates(
    Path(__file__).parent / "templates", {"line": _escape_line}, autoescape=True
)


def build_page(title: str, lead: str, sections: Iterable[tuple[str, Sequence[Block]]]) -> str:
    """Build a page of (heading, blocks); sections without blocks are left out."""
    shown = [(words, blocks) for words, blocks in sections if blocks]
    return fill_template("page.html", title=title, lead=lead, sections=shown, mark=REPORT_MARK)


def build_row(figures: Iterable[Figure | None]) -> list[Block]:
    """Return a row of the figures that exist; empty without any."""
    known = [figure for figure in figures if figure is not None]
    return [Row(known)] if known else []


def show_documents(documents: Documents, show: Callable[[str, Any], list[Block]]) -> list[Block]:
    """Show every document; name one that does not have dmrl's form."""
    blocks: list[Block] = []
    for name, said in documents.items():
        try:
            blocks += [Heading(name), *show(name, said)]
        except INVALID_DATA_ERRORS as e:
            blocks.append(Text(f"{name} does not have dmrl's form ({e!r})."))
    return blocks


def extract_valid(documents: Documents, take: Callable[[Any], Any]) -> dict[str, Any]:
    """Apply ``take`` to every document that has the values it needs."""
    out = {}
    for name, said in documents.items():
        try:
            out[name] = take(said)
        except INVALID_DATA_ERRORS:
            continue
    return out


def draw_or_explain(draw: Callable[..., str], *given: Any, caption: str) -> Figure:
    """Draw a chart; a reason if its data are invalid."""
    try:
        return Figure(caption, svg=draw(*given))
    except INVALID_DATA_ERRORS as e:
        return Figure(caption, failure=f"cannot be drawn ({e!r}).")


@dataclass(slots=True)
class ImageEmbedder:
    """Embed images in a page until it is full.

    Parameters
    ----------
    room
        Bytes of the page that are left.
    """

    room: int = MAX_PAGE_BYTES

    def embed(self, path: Path, caption: str, *, full: bool = False) -> Figure:
        """Embed an image with a caption; large images are scaled down."""
        try:
            data, kind = _read_scaled(path)
        except (DmrlError, OSError) as e:
            return Figure(path.name, failure=str(e))
        words = b64encode(data).decode()
        if len(words) > self.room:
            return Figure(path.name, failure="no room left in this page. Open the file instead")
        self.room -= len(words)
        return Figure(caption, image=f"data:image/{kind};base64,{words}", full=full)

    def embed_if_present(self, path: Path, caption: str, *, full: bool = False) -> Figure | None:
        """Embed an image; None if there is no file, or a link."""
        there = path.is_file() and not path.is_symlink()
        return self.embed(path, caption, full=full) if there else None


def _read_scaled(path: Path) -> tuple[bytes, str]:
    """Return an image's bytes and format; large images become JPEG."""
    data = path.read_bytes()
    if len(data) <= MAX_PLAIN_PNG_BYTES and data.startswith(b"\x89PNG"):
        return data, "png"
    rgb = decode(data, path, limits.PIXELS)
    height, width = rgb.shape[:2]
    if width > MAX_IMAGE_WIDTH_PX:
        to = (MAX_IMAGE_WIDTH_PX, max(1, round(height * MAX_IMAGE_WIDTH_PX / width)))
        rgb = crop_and_scale(rgb, (0, 0, width, height), *to)
    return encode_jpeg(rgb, 85), "jpeg"
