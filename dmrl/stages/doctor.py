"""``dmrl doctor``: installed packages, programs and devices, and how to get missing ones.

It installs nothing. A missing part is an error only if dmrl itself needs it.
"""

from dataclasses import asdict
from typing import TYPE_CHECKING

from dmrl.errors import SettingError
from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import print_json, print_line, print_table

if TYPE_CHECKING:
    from dmrl.installation import Part


def command(*, as_json: AsJson = False) -> None:
    """List packages, programs and devices that dmrl uses, and how to get missing ones."""
    from dmrl.installation import list_parts

    found = list_parts()
    if as_json:
        print_json([asdict(part) for part in found])
    else:
        rows = [(part.name, part.found or "-", part.serves, part.remedy) for part in found]
        print_table("", ("what", "found", "for", "to get it"), rows)
    if lacking := [part for part in found if part.needed and not part.there]:
        raise SettingError(f"{lacking[0].name}: {lacking[0].found}. Try: {lacking[0].remedy}")
    if not as_json:
        print_line(_conclude(found))


def _conclude(found: "list[Part]") -> str:
    """Return the last line: whether the base works, and the missing parts."""
    missing = [part.name for part in found if not part.there]
    rest = f"Not there: {', '.join(missing)}" if missing else "Nothing is missing"
    return f"The base works. {rest}."
