"""Write the card of a dataset: README.md, croissant.json and figures/ in its folder.

All its content is counted from the data or read from provenance.json, so the card can be written
again at any time. From the old card these are kept: title, license, and the text below the line
``USER_TEXT_MARK``.
"""

from pathlib import Path
from types import ModuleType

import numpy as np

from dmrl.atomic_output import rewritten_file
from dmrl.card import sections
from dmrl.card.croissant import NAME as CROISSANT
from dmrl.card.croissant import croissant
from dmrl.card.facts import cautions, equipment, read_facts
from dmrl.card.front_matter import check_license, front_matter, read_front
from dmrl.card.leakage import leaks
from dmrl.card.statistics import Counts, count, sigmas_of
from dmrl.datasets import Split, open_dataset
from dmrl.errors import DatasetError, MissingExtra
from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards.bounded_parsing import parse_json
from dmrl.recording import Provenance
from dmrl.recording.provenance import FILE_NAME
from dmrl.terminal.progress import say

YOURS = "<!-- What you write below this line stays when dmrl writes the card again. -->"
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
    made = _provenance(folder)
    old, readme = folder / "README.md", (into or folder) / "README.md"
    yours = _yours(old)
    before = read_front(old)
    title = title or before.get("pretty_name") or made.settings.get("title") or _title(made)
    license_id = license_id or before.get("license") or made.settings.get("license", "unknown")
    counts = {name: count(split) for name, split in splits.items()}
    figures = _draw(readme.parent / "figures", counts, splits)
    files = {name: [file.relative_to(folder) for file in dataset.files(name)] for name in splits}
    packed = files if dataset.parquet else {}
    text = [*front_matter(splits, str(title), str(license_id), packed)]
    text += sections.about(splits, str(title), made)
    text += sections.loading(splits, parquet=dataset.parquet)
    facts = read_facts(folder)
    text += [*sections.numbers(counts), *cautions(facts, sigmas_of(splits), leaks(splits))]
    text += sections.limits(counts, made)
    if facts is not None:
        text += ["## Sensors and frames", "", *equipment(facts), *sections.FRAMES, ""]
    text += [*figures, *sections.features(splits)]
    text += ["## Provenance", "", *sections.ancestry(made), "", YOURS]
    written = "\n".join(text) + (yours or "\n")
    about = croissant(
        splits,
        made,
        title=str(title),
        license_id=str(license_id),
        licences=facts.licences if facts else {},
        files=files,
        parquet=dataset.parquet,
    )
    for path, content in ((readme, written), (readme.parent / CROISSANT, about)):
        with rewritten_file(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return readme


def _yours(readme: Path) -> str:
    """Return the text that a person wrote below the last line of the card; empty without any."""
    try:
        return readme.read_text(encoding="utf-8").partition(YOURS)[2] if readme.is_file() else ""
    except UnicodeDecodeError as e:
        raise DatasetError(f"{readme} is not UTF-8 ({e}). Save it as UTF-8, or remove it") from None


def _draw(folder: Path, counts: dict[str, Counts], splits: dict[str, Split]) -> list[str]:
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
    plots.depth_histogram({n: c.depth_m for n, c in counts.items()}, folder / "depth")
    plots.position_heat(every, width_px, height_px, 2 * STRIDE_PX, folder / "position")
    plots.peers_per_image({n: c.peers for n, c in counts.items()}, folder / "peers")
    names = {"depth": "Depth", "position": "Position in the image", "peers": "Peers per image"}
    lines = [f"![{text}](figures/{name}.png)" for name, text in names.items()]
    return ["## Distributions", "", "Peers inside the images. Also as SVG.", "", *lines, ""]


def _provenance(folder: Path) -> Provenance:
    path = folder / FILE_NAME
    try:
        return Provenance.from_json(parse_json(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise DatasetError(f"{path} cannot be read ({e}). Make the dataset again") from None


def _title(made: Provenance) -> str:
    names = [source.name for source in made.inputs if not source.name.endswith(".csv")]
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"Peer robots in camera images: {names[0]}{more}" if names else "Peer robots"
