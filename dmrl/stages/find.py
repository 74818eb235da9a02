"""``dmrl find``: recordings that match a query, from the table that `dmrl index` writes."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import count_things, print_json, print_line, print_table


def command(
    query: str,
    folder: Path = Path(),
    /,
    *,
    paths: Annotated[bool, Parameter(negative=())] = False,
    as_json: AsJson = False,
) -> None:
    """Find recordings by their contents: the table of dmrl index, queried in SQL.

    Parameters
    ----------
    query
        Condition, such as 'camera = "cf1" and ok_labels > 100'. docs/catalogue.md has
        the columns.
    folder
        Folder that was indexed. Without it, this one.
    paths
        Print their paths alone, a line each.
    """
    from dmrl.catalogue import open_catalogue
    from dmrl.catalogue.display import HEADS, display_rows
    from dmrl.catalogue.query import find_rows

    found = find_rows(open_catalogue(folder), query)
    if as_json:
        print_json({"folder": str(folder), "recordings": found.to_pylist()})
    elif paths:
        for name in found["recording"].to_pylist():
            print_line(str(folder / name))
    else:
        print_table(
            f"{count_things(found.num_rows, 'recording')} in {folder}", HEADS, display_rows(found)
        )
