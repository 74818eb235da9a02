"""Output at the end of a command: a table and lines for people, or one JSON document."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from types import SimpleNamespace as Given
from typing import Any

from dmrl.terminal.tables import print_json, print_line, print_table

__all__ = ["Closing", "Given"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Closing:
    """Describe how the result of a stage is printed.

    Functions get the result of ``run`` and the arguments of the command, by name.

    Parameters
    ----------
    columns
        Heads of a table whose title is the output. Empty: no table.
    rows
        Build the rows of the table. None: one row per dataclass, or per item of a dict.
    lines
        Build lines that follow the table.
    show
        Print everything, in place of ``columns``, ``rows`` and ``lines``.
    path_key
        Key of the output's path in the JSON document. Empty: the path is left out.
    result_key
        Key of the result in the JSON document. Empty: its own keys are keys of the document.
    document
        Build the JSON document, in place of both keys.
    """

    columns: Sequence[str] = ()
    rows: Callable[[Any, Given], Iterable[Sequence[Any]]] | None = None
    lines: Callable[[Any, Given], Iterable[str]] = lambda _result, _given: ()
    show: Callable[[Any, Given], None] | None = None
    path_key: str = ""
    result_key: str = ""
    document: Callable[[Any, Given], Any] | None = None

    @property
    def has_json(self) -> bool:
        """Whether a JSON document is described."""
        return bool(self.path_key or self.document)

    def print(
        self,
        result: Any,
        given: Given,
        *,
        as_json: bool = False,
        left_out: Mapping[str, int] | None = None,
    ) -> None:
        """Print a result, as JSON or for people. ``left_out``: counts for the JSON, by reason."""
        if as_json:
            document = (self.document or self._document)(result, given)
            can_leave_out = hasattr(getattr(given, "settings", None), "strict")
            if isinstance(document, dict) and (left_out or can_leave_out):
                document = {"left_out": dict(left_out or {})} | document
            print_json(document)
            return
        if self.show is not None:
            self.show(result, given)
            return
        if self.columns:
            rows = to_rows(result) if self.rows is None else self.rows(result, given)
            print_table(str(given.out), self.columns, list(rows))
        for line in self.lines(result, given):
            print_line(line)

    def _document(self, result: Any, given: Given) -> dict[str, Any]:
        values = to_plain(result)
        own = {self.result_key: values} if self.result_key else values
        return {self.path_key: str(given.out), **own}


def to_plain(result: Any) -> Any:
    """Return dataclasses as dicts, alone or in a list; anything else unchanged."""
    if isinstance(result, list):
        return [to_plain(one) for one in result]
    return asdict(result) if is_dataclass(result) and not isinstance(result, type) else result


def to_rows(result: Any) -> Iterable[Sequence[Any]]:
    """Return a row per item of a dict, per dataclass of a list, or of one dataclass."""
    if isinstance(result, Mapping):
        return list(result.items())
    parts = result if isinstance(result, list) else [result]
    return [list(asdict(part).values()) for part in parts]
