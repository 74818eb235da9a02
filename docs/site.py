"""Hooks of mkdocs: pages that lie outside docs/ join the site, and links fit it.

A link that shows the name of a page's file shows its title instead; links to code become plain
words.
"""

import re
from functools import cache
from pathlib import Path, PurePosixPath
from posixpath import relpath
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = {
    "README.md": "readme.md",
    "SECURITY.md": "security.md",
    "CONTRIBUTING.md": "contributing.md",
    "examples/README.md": "examples.md",
    "dmrl/learn/pretrained/dmrl-nano/README.md": "networks/dmrl-nano.md",
    "dmrl/learn/pretrained/dmrl-nano-violet/README.md": "networks/dmrl-nano-violet.md",
}
"""Pages of the repository, and what they are called on the site."""
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]*)(#[^)\s]*)?\)")
FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie outside docs/, and the pictures in README.md."""
    for source, name in PAGES.items():
        files.append(File.generated(config, name, content=_read_page(source)))
    return files


def _read_page(source: str) -> str:
    """Return a page of the repository without the front matter of a card."""
    text = (ROOT / source).read_text(encoding="utf-8")
    return re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)


@cache
def _read_title(source: str) -> str:
    """Return the heading of a page, up to its colon."""
    heading = re.search(r"^# ([^:\n]+)", _read_page(source), re.MULTILINE)
    assert heading is not None, f"{source} has no heading"
    return heading[1]


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Mend links for where the page stands on the site."""
    name = page.file.src_uri
    source = next((s for s, on_site in PAGES.items() if on_site == name), f"docs/{name}")
    parts = FENCE.split(markdown)
    return "".join(part if k % 2 else _mended(part, source, name) for k, part in enumerate(parts))


def _mended(text: str, source: str, name: str) -> str:
    def mend(link: re.Match[str]) -> str:
        bang, words, place, anchor = link[1], link[2], link[3], link[4] or ""
        if not place or ":" in place:
            return link[0]
        target = relpath((PurePosixPath(source).parent / place).as_posix(), ".")
        if target in PAGES:
            on_site = PAGES[target]
        elif target.startswith("docs/"):
            on_site = target.removeprefix("docs/")
        else:
            return words  # code, schemas and folders are in the repository
        if words in (place, PurePosixPath(place).name) and place.endswith(".md"):
            words = _read_title(target)
        return f"{bang}[{words}]({relpath(on_site, PurePosixPath(name).parent)}{anchor})"

    return LINK.sub(mend, text)
