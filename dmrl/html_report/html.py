"""Build one self-contained HTML file: no requests, no scripts, and all text is escaped."""

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from dmrl.errors import DmrlError, to_one_line
from dmrl.guards import limits
from dmrl.images.codec import crop_and_scale, decode, encode_jpeg

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
STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #ffffff; --line: #d0d7de;
  --soft: #57606a; --card: #f6f8fa; --link: #0969da }
@media (prefers-color-scheme: dark) { :root { --ink: #e6edf3; --paper: #0d1117; --line: #30363d;
  --soft: #9198a1; --card: #161b22; --link: #4493f8 } }
* { box-sizing: border-box }
body { margin: 0 auto; max-width: 72rem; padding: 1rem; color: var(--ink); background: var(--paper);
  font: 16px/1.5 system-ui, sans-serif }
h1 { font-size: 1.6rem; margin: .5rem 0 } h2 { font-size: 1.25rem; margin: 2rem 0 .5rem;
  border-bottom: 1px solid var(--line) } h3 { font-size: 1rem; margin: 1.2rem 0 .4rem }
p, figcaption { color: var(--soft) } p.big { color: var(--ink); font-size: 1.1rem }
nav a { margin-right: 1rem; display: inline-block; color: var(--link) }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: .9rem }
th, td { text-align: left; padding: .25rem .7rem .25rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top } td.n, th.n { text-align: right; font-variant-numeric: tabular-nums }
.row { display: flex; flex-wrap: wrap; gap: 1rem } figure { margin: 0; flex: 1 1 24rem;
  min-width: 0; max-width: min(100%, 35rem) } figure.full { flex-basis: 100%; max-width: 100% }
figure svg { width: 100%; height: auto; max-height: 34rem }
figure img { max-width: 100%; height: auto; background: #fff; border-radius: 4px }
code { background: var(--card); padding: .1rem .3rem; border-radius: 4px; font-size: .85rem;
  overflow-wrap: anywhere }
"""
CONTENT_SECURITY_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def to_html_text(value: object) -> str:
    """Convert any value to HTML text: one line, no markup."""
    if value is None:
        return ""
    return escape(f"{value:.4g}" if isinstance(value, float) else to_one_line(str(value)))


def build_table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Build a table; columns of numbers, or of texts that begin with one, are right-aligned."""
    body = [[to_html_text(cell) for cell in row] for row in rows]
    number = [
        bool(body) and all(row[k][:1].lstrip("-").isdigit() or not row[k] for row in body)
        for k in range(len(columns))
    ]
    kind = ["n" if n else "" for n in number]

    def line(tag: str, cells: Sequence[str]) -> str:
        parts = (f'<{tag} class="{k}">{c}</{tag}>' for c, k in zip(cells, kind, strict=True))
        return f"<tr>{''.join(parts)}</tr>"

    head = line("th", [to_html_text(column) for column in columns])
    return (
        f'<div class="wide"><table>{head}{"".join(line("td", row) for row in body)}</table></div>'
    )


def build_chart(svg: str, caption: str, *, least_rem: int = 0) -> str:
    """Build a figure from SVG with a caption; ``least_rem`` wide at least, else it scrolls."""
    words = f"<figcaption>{to_html_text(caption)}</figcaption>"
    if not least_rem:
        return f"<figure>{svg}{words}</figure>"
    wide = f'<div class="wide"><div style="min-width: {least_rem}rem">{svg}</div></div>'
    return f'<figure class="full">{wide}{words}</figure>'


def build_row(figures: Iterable[str]) -> str:
    """Place figures beside each other, as far as the page is wide enough. Empty without figures."""
    inside = "".join(figures)
    return f'<div class="row">{inside}</div>' if inside else ""


@dataclass(slots=True)
class ImageEmbedder:
    """Embed images in a page until it is full.

    Parameters
    ----------
    room
        Bytes of the page that are left.
    """

    room: int = MAX_PAGE_BYTES

    def build_figure(self, path: Path, caption: str, *, full: bool = False) -> str:
        """Build a figure with an embedded image and a caption; large images are scaled down."""
        try:
            data, kind = _read_scaled(path)
        except (DmrlError, OSError) as e:
            return f"<p>{to_html_text(path.name)}: {to_html_text(e)}</p>"
        words = b64encode(data).decode()
        if len(words) > self.room:
            return (
                f"<p>{to_html_text(path.name)}: no room left in this page. Open the file "
                "instead</p>"
            )
        self.room -= len(words)
        where = f"data:image/{kind};base64,{words}"
        image = f'<img src="{where}" alt="{to_html_text(caption)}" loading="lazy">'
        chosen = ' class="full"' if full else ""
        return f"<figure{chosen}>{image}<figcaption>{to_html_text(caption)}</figcaption></figure>"


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


def build_page(title: str, lead: str, sections: Sequence[tuple[str, str]]) -> str:
    """Build the page.

    Parameters
    ----------
    title
        Its title.
    lead
        Its summary, one sentence.
    sections
        (heading, HTML); sections without content are left out.
    """
    shown = [(words, body) for words, body in sections if body]
    links = "".join(
        f'<a href="#s{k}">{to_html_text(words)}</a>' for k, (words, _) in enumerate(shown)
    )
    parts = "".join(
        f'<section id="s{k}"><h2>{to_html_text(words)}</h2>{body}</section>'
        for k, (words, body) in enumerate(shown)
    )
    return (
        f'<!doctype html>\n{REPORT_MARK}\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_SECURITY_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{to_html_text(title)}</title><style>{STYLE}</style></head><body>"
        f'<h1>{to_html_text(title)}</h1><p class="big">{to_html_text(lead)}</p>'
        f"<nav>{links}</nav>{parts}"
        "</body></html>\n"
    )
