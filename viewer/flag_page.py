"""Write a page to mark bad rows of a dataset: images to click, and a CSV file to save.

rerun reports no clicks to a program, so this is a separate page: one HTML file that opens offline,
with the rows in the order of the layout ``dataset``.
"""

import io
import json
from base64 import b64encode
from collections.abc import Iterator, Sequence
from hashlib import sha256
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.atomic_output import atomic_file
from dmrl.colours import RGB
from dmrl.datasets import layout
from dmrl.datasets.writing.exclusions import REQUIRED_COLUMNS
from dmrl.errors import to_one_line
from dmrl.images.codec import crop_and_scale, decode, encode_jpeg
from dmrl.terminal.progress import track
from dmrl.viewer.browse import RankedRows, image_size, rank_dataset
from dmrl.viewer.settings import Settings

WIDE_PX = 240
"""Width of an image on the page, pixels."""
STYLE = """
:root { color-scheme: light dark; font: 15px/1.4 system-ui, sans-serif }
body { margin: 0 auto; max-width: 80rem; padding: 0 1rem 4rem }
header { position: sticky; top: 0; background: Canvas; padding: .6rem 0; z-index: 1 }
button { font: inherit; padding: .4rem .9rem }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr)); gap: .6rem }
label { display: block; cursor: pointer; border: 3px solid transparent; border-radius: 6px }
label:has(:checked) { border-color: #d55e00 }
label:has(:checked) svg { opacity: .45 }
svg { width: 100%; height: auto; display: block }
small { display: block; overflow-wrap: anywhere; padding: .1rem .2rem }
"""
SCRIPT = """
const boxes = [...document.querySelectorAll('input')], count = document.querySelector('output');
const cell = s => '"' + String(s).replaceAll('"', '""') + '"';
const show = () => count.value = boxes.filter(b => b.checked).length;
document.addEventListener('change', show);
document.querySelector('button').addEventListener('click', () => {
  const rows = boxes.filter(b => b.checked).map(b => JSON.parse(b.value).map(cell).join(','));
  const text = [HEAD, ...rows].join('\\n') + '\\n';
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([text], {type: 'text/csv'}));
  link.download = 'flags.csv';
  link.click();
});
show();
""".replace("HEAD", json.dumps(",".join(REQUIRED_COLUMNS)))


def write_flag_page(paths: Sequence[Path], out: Path, settings: Settings) -> int:
    """Write the page of a dataset's rows, and return their number.

    Parameters
    ----------
    paths
        The dataset, and optionally recordings with a model's detections: then worst rows first.
    out
        Page to write. Must not exist.
    settings
        Selects the rows and their number.

    Raises
    ------
    DatasetError
        If the dataset or the rows do not exist.
    SettingError
        If the paths contain no dataset.
    OutputError
        If ``out`` exists or cannot be written.
    """
    folder, ranked = rank_dataset(paths, settings)
    with atomic_file(out) as partial:
        partial.write_text(page(folder.name, ranked), encoding="utf-8")
    return len(ranked.rows)


def page(name: str, ranked: RankedRows) -> str:
    """Build the page, HTML; file names are escaped."""
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{_hash_script(SCRIPT)}'"
    )
    cells = "".join(track(_cells(ranked), "Drawing", len(ranked.rows)))
    more = f" of {ranked.of}" if ranked.of > len(ranked.rows) else ""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(name)}</title><style>{STYLE}</style></head><body><header>"
        f"<b>{_text(name)}</b>: {len(ranked.rows)}{more} rows. Click the bad ones. "
        "<output></output> marked: <button>save flags.csv</button>, then run "
        f"<code>dmrl dataset ... --without flags.csv</code></header><main>{cells}</main>"
        f"<script>{SCRIPT}</script></body></html>\n"
    )


def _text(words: str) -> str:
    return escape(to_one_line(words))


def _hash_script(script: str) -> str:
    return b64encode(sha256(script.encode()).digest()).decode()


def _cells(ranked: RankedRows) -> Iterator[str]:
    wide, high = image_size(ranked.rows)
    for k in range(len(ranked.rows)):
        row = ranked.rows.slice(k, 1).to_pylist()[0]
        value = escape(json.dumps([row[name] for name in REQUIRED_COLUMNS]))
        error = ranked.error_px[k]
        judged = f", error {error:.1f} px" if np.isfinite(error) else ""
        words = f"{row['source']}, {row['robot']}, {row['log_time'] / 1e9:.2f} s{judged}"
        yield (
            f'<label><input type="checkbox" value="{value}">{_draw_thumbnail(row, wide, high)}'
            f"<small>{_text(words)}</small></label>"
        )


def _draw_thumbnail(row: dict[str, object], wide: int, high: int) -> str:
    """Draw a small image with a circle around every labelled peer."""
    size = (WIDE_PX, max(1, round(high * WIDE_PX / wide)))
    small = encode_jpeg(crop_and_scale(_pixels(row, wide, high), (0, 0, wide, high), *size), 80)
    marks = io.StringIO()
    peers = row["peers"]
    assert isinstance(peers, list)
    for peer in peers:
        red, green, blue = RGB.get(peer["source"], RGB["other"])
        line = f'fill="none" stroke="rgb({red},{green},{blue})" stroke-width="2"'
        marks.write(f'<circle cx="{peer["u_px"]:.1f}" cy="{peer["v_px"]:.1f}" r="14" {line}/>')
    data = b64encode(small).decode()
    return (
        f'<svg viewBox="0 0 {wide} {high}"><image width="{wide}" height="{high}" '
        f'href="data:image/jpeg;base64,{data}"/>{marks.getvalue()}</svg>'
    )


def _pixels(row: dict[str, object], wide: int, high: int) -> NDArray[np.uint8]:
    if layout.PIXELS in row:
        raw = row[layout.PIXELS]
        assert isinstance(raw, bytes)
        return np.frombuffer(raw, np.uint8).reshape(high, wide, 3)
    image = row[layout.IMAGE]
    assert isinstance(image, dict)
    return decode(image["bytes"], "a row's image")
