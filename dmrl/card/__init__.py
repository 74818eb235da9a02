"""Write the card of a dataset: README.md, croissant.json and figures/ in its folder.

All its content is counted from the data or read from provenance.json, so the card can be written
again at any time. From the old card these are kept: title, license, date of publication, and the
text below the line ``USER_TEXT_MARK``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dmrl.atomic_output import replace_file
from dmrl.card.croissant import CROISSANT_FILE, build_croissant, read_publication_date
from dmrl.card.describe import describe_dataset, describe_facts
from dmrl.card.facts import read_facts
from dmrl.card.figures import draw_figures
from dmrl.card.front_matter import check_license, read_front_matter
from dmrl.card.templating import fill_template
from dmrl.datasets import open_dataset
from dmrl.errors import DatasetError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.recording import Provenance
from dmrl.recording.provenance import FILE_NAME

USER_TEXT_MARK = "<!-- What you write below this line stays when dmrl writes the card again. -->"
"""Last line of the generated card. Cards written before contain it, so it never changes."""
DEFAULT_TITLE = "Peer robots in camera images"
"""Beginning of a title that nobody chose."""


def write_card(
    folder: Path,
    *,
    title: str | None = None,
    license: str | None = None,
    published: str | None = None,
    into: Path | None = None,
) -> Path:
    """Write the README.md of a dataset, and return its path.

    Parameters
    ----------
    folder
        A dataset.
    title, license, published
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
    if license is not None:
        check_license(license)
    dataset = open_dataset(folder)
    about = describe_dataset(dataset, read_provenance_file(folder))
    made, old, readme = about["made"], folder / "README.md", (into or folder) / "README.md"
    facts = read_facts(folder)
    about |= {"mark": USER_TEXT_MARK, "yours": _read_user_text(old) or "\n"}
    before = read_front_matter(old)
    about["title"] = title or _choose_title(before.get("pretty_name"), about)
    about["license_id"] = str(
        license or before.get("license") or made.settings.get("license", "unknown")
    )
    about["published"] = published or read_publication_date(folder)
    about |= {"facts": facts} | (describe_facts(facts) if facts else {})
    about["samples"] = draw_figures(readme.parent / "figures", about)
    contents = {
        readme: fill_template("README.md", **about),
        readme.parent / CROISSANT_FILE: build_croissant(about),
    }
    for path, content in contents.items():
        with replace_file(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return readme


def _read_user_text(readme: Path) -> str:
    """Return the text that a person wrote below the last line of the card; empty without any."""
    if not readme.is_file():
        return ""
    try:
        return readme.read_text(encoding="utf-8").partition(USER_TEXT_MARK)[2]
    except UnicodeDecodeError as e:
        raise DatasetError(f"{readme} is not UTF-8 ({e}). Save it as UTF-8, or remove it") from None


def read_provenance_file(folder: Path) -> Provenance:
    """Read the provenance of a dataset.

    Raises
    ------
    DatasetError
        If it is missing or damaged.
    """
    path = folder / FILE_NAME
    try:
        return Provenance.from_json(parse_json(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise DatasetError(f"{path} cannot be read ({e}). Make the dataset again") from None


def _choose_title(before: str | None, about: Mapping[str, Any]) -> str:
    """Return the title that a person chose, or one of all recordings."""
    chosen = before or about["made"].settings.get("title")
    if chosen and not chosen.startswith(DEFAULT_TITLE):
        return str(chosen)
    names = sorted({name for name, _, _ in about["recordings"]})
    return f"{DEFAULT_TITLE}: {names[0] if len(names) == 1 else f'{len(names)} recordings'}"
