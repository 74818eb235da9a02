"""Write the card of a dataset: README.md, croissant.json and figures/ in its folder.

All its content is counted from the data or read from provenance.json, so the card can be written
again at any time. From the old card these are kept: title, license, and the text below the line
``USER_TEXT_MARK``.
"""

from pathlib import Path
from types import ModuleType

import numpy as np

from dmrl.atomic_output import replace_file
from dmrl.card import sections
from dmrl.card.croissant import CROISSANT_FILE as CROISSANT
from dmrl.card.croissant import build_croissant
from dmrl.card.facts import read_facts, sensor_lines, warning_lines
from dmrl.card.front_matter import build_front_matter, check_license, read_front_matter
from dmrl.card.leakage import leakage_lines
from dmrl.card.statistics import SplitCounts, count_split, summarize_sigmas
from dmrl.datasets import Split, open_dataset
from dmrl.errors import DatasetError, MissingExtra
from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards.bounded_parsing import parse_json
from dmrl.recording import Provenance
from dmrl.recording.provenance import FILE_NAME
from dmrl.terminal.progress import say

USER_TEXT_MARK = "<!-- What you write below this line stays when dmrl writes the card again. -->"
"""Last line of the generated card. Cards written before contain it, so it never changes."""

plots: ModuleType | None
try:
    from dmrl import plots
except MissingExtra:
    plots = None


def write_card(
    folder: Path,
    *,
    title: str | None = None,
    license_id: str | None = None,
    into: Path | None = None,
) -> Path:
    """Write the README.md of a dataset, and return its path.

    Parameters
    ----------
    folder
        A dataset.
    title, license_id
        None: those of the old card, or of the dataset's settings.
    into
        Another folder for the card. None: the dataset's own, where it replaces the old card.

    Raises
    ------
    DatasetError
        If the folder is not a dataset, or lacks a shard or its provenance.
    SettingError
        If the licence is unknown.
    """
    if license_id is not None:
        check_license(license_id)
    dataset = open_dataset(folder)
    splits = {name: dataset.split(name) for name in dataset.splits}
    made = _read_provenance(folder)
    old, readme = folder / "README.md", (into or folder) / "README.md"
    yours = _read_user_text(old)
    before = read_front_matter(old)
    title = title or before.get("pretty_name") or made.settings.get("title") or _default_title(made)
    license_id = license_id or before.get("license") or made.settings.get("license", "unknown")
    counts = {name: count_split(split) for name, split in splits.items()}
    figures = _draw_figures(readme.parent / "figures", counts, splits)
    files = {
        name: [file.relative_to(folder) for file in dataset.list_shards(name)] for name in splits
    }
    packed = files if dataset.parquet else {}
    text = [*build_front_matter(splits, str(title), str(license_id), packed)]
    text += sections.intro_lines(splits, str(title), made)
    text += sections.loading_lines(splits, parquet=dataset.parquet)
    facts = read_facts(folder)
    text += [
        *sections.count_lines(counts),
        *warning_lines(facts, summarize_sigmas(splits), leakage_lines(splits)),
    ]
    text += sections.limit_lines(counts, made)
    if facts is not None:
        text += ["## Sensors and frames", "", *sensor_lines(facts), *sections.FRAMES, ""]
    text += [*figures, *sections.column_lines(splits)]
    text += ["## Provenance", "", *sections.ancestry_lines(made), "", USER_TEXT_MARK]
    written = "\n".join(text) + (yours or "\n")
    about = build_croissant(
        splits,
        made,
        title=str(title),
        license_id=str(license_id),
        licences=facts.licences if facts else {},
        files=files,
        parquet=dataset.parquet,
    )
    for path, content in ((readme, written), (readme.parent / CROISSANT, about)):
        with replace_file(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return readme


def _read_user_text(readme: Path) -> str:
    """Return the text that a person wrote below the last line of the card; empty without any."""
    try:
        return (
            readme.read_text(encoding="utf-8").partition(USER_TEXT_MARK)[2]
            if readme.is_file()
            else ""
        )
    except UnicodeDecodeError as e:
        raise DatasetError(f"{readme} is not UTF-8 ({e}). Save it as UTF-8, or remove it") from None


def _draw_figures(
    folder: Path, counts: dict[str, SplitCounts], splits: dict[str, Split]
) -> list[str]:
    if plots is None:
        say("card without figures: pip install 'dmrl[plot]', then dmrl card")
        return []
    if folder.is_symlink():
        raise DatasetError(f"{folder} is a link to another folder. Remove it")
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        if old.is_symlink():  # writing would change the file that it points to
            raise DatasetError(f"{old} is a link to another file. Remove it")
    height_px, width_px = next(iter(splits.values())).image_shape
    every = np.concatenate([c.uv_px for c in counts.values()])
    plots.plot_depth_histogram({n: c.depth_m for n, c in counts.items()}, folder / "depth")
    plots.plot_position_heat(every, width_px, height_px, 2 * STRIDE_PX, folder / "position")
    plots.plot_peers_per_image({n: c.peers for n, c in counts.items()}, folder / "peers")
    names = {"depth": "Depth", "position": "Position in the image", "peers": "Peers per image"}
    lines = [f"![{text}](figures/{name}.png)" for name, text in names.items()]
    return ["## Distributions", "", "Peers inside the images. Also as SVG.", "", *lines, ""]


def _read_provenance(folder: Path) -> Provenance:
    path = folder / FILE_NAME
    try:
        return Provenance.from_json(parse_json(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise DatasetError(f"{path} cannot be read ({e}). Make the dataset again") from None


def _default_title(made: Provenance) -> str:
    names = [source.name for source in made.inputs if not source.name.endswith(".csv")]
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"Peer robots in camera images: {names[0]}{more}" if names else "Peer robots"
