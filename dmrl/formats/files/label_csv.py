"""Labels of images in a CSV file: reading and writing of rows."""

import csv
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from dmrl.errors import SourceError, suggest
from dmrl.guards import limits
from dmrl.guards.bounded_parsing import parse_number
from dmrl.guards.safe_names import check_split_name
from dmrl.samples.sample import LABEL_SOURCES

POINT_COLUMNS = ("u_px", "v_px", "depth_m")
BOX_COLUMNS = ("left_px", "top_px", "right_px", "bottom_px")
SIGMA_COLUMNS = ("sigma_u_px", "sigma_v_px", "sigma_depth_m")
REQUIRED_COLUMNS = ("file", "peer")
COLUMNS = (
    *REQUIRED_COLUMNS,
    *POINT_COLUMNS,
    *BOX_COLUMNS,
    "visible_share",
    "source",
    "split",
    *SIGMA_COLUMNS,
)


@dataclass(frozen=True, slots=True)
class LabelRow:
    """One peer in one image.

    Parameters
    ----------
    file
        Name of the image.
    peer
        The robot in view; empty: no peer is in view.
    u_px, v_px
        Projection of its centre, pixel-edge coordinates.
    depth_m
        Distance along the optical axis, metres; 0: unknown, its sigma is infinite then.
    box_px
        Left, top, right, bottom of the visible part; empty if unknown.
    visible_share
        Share of the peer's pixels that are not hidden, 0 to 1; 0: unknown.
    source
        truth, estimate, published or hand.
    split
        train, test or another; None: no split.
    sigmas
        One standard deviation of u, v (px) and depth (m); 0: exact or unknown.
    depth_from_box
        The depth is from the width of the box and the stated width of the robot.
    """

    file: str
    peer: str
    u_px: float = 0.0
    v_px: float = 0.0
    depth_m: float = 0.0
    box_px: tuple[float, ...] = ()
    visible_share: float = 0.0
    source: str = "hand"
    split: str | None = None
    sigmas: tuple[float, ...] = (0.0, 0.0, 0.0)
    depth_from_box: bool = False

    def is_centre_in_box(self) -> bool:
        """Return whether the centre lies in the box."""
        left, top, right, bottom = self.box_px
        return left <= self.u_px <= right and top <= self.v_px <= bottom

    def scale(self, width: float, height: float) -> "LabelRow":
        """Return the label with its pixels multiplied by a width and a height."""
        box = tuple(edge * (width, height)[k % 2] for k, edge in enumerate(self.box_px))
        return replace(self, u_px=self.u_px * width, v_px=self.v_px * height, box_px=box)

    def to_fields(self) -> dict[str, Any]:
        """Return the fields of a PeerLabel."""
        names = ("peer", *POINT_COLUMNS, "visible_share", "source")
        point = {name: getattr(self, name) for name in names}
        return (
            point
            | dict(zip(SIGMA_COLUMNS, self.sigmas, strict=True))
            | {"box_px": list(self.box_px)}
            | ({"depth_from_box": True} if self.depth_from_box else {})
        )

    def to_cells(self) -> list[str]:
        """Return the cells of the row in the order of ``COLUMNS``; unknown values are empty."""
        if not self.peer:
            return [self.file, *[""] * 9, self.source, self.split or "", "", "", ""]
        depth = f"{self.depth_m:.5f}" if self.depth_m else ""
        point = [f"{self.u_px:.4f}", f"{self.v_px:.4f}", depth]
        box = [f"{edge:g}" for edge in self.box_px] or [""] * 4
        share = f"{self.visible_share:.4f}" if self.visible_share else ""
        sigmas = [f"{sigma:g}" if 0 < sigma < math.inf else "" for sigma in self.sigmas]
        head = [self.file, self.peer, *point, *box, share]
        return [*head, self.source, self.split or "", *sigmas]


def write_labels(stream: TextIO, rows: Sequence[LabelRow]) -> None:
    """Write rows as ``read_labels`` reads them. The stream needs ``newline=""``."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(row.to_cells() for row in rows)


def read_labels(path: Path, files: Collection[str]) -> dict[str, list[LabelRow]]:
    """Read rows by image, in the order of the file.

    Parameters
    ----------
    path
        CSV file with a header; see ``COLUMNS``.
    files
        Names of the existing images.

    Raises
    ------
    SourceError
        If a column is unknown or missing, a cell is not a number, an image does not exist,
        or rows contradict each other: names file and line.
    """
    found: dict[str, list[LabelRow]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, strict=True)
            _check_columns(path, reader.fieldnames or ())
            for cells in reader:
                row = _parse_row(f"{path}:{reader.line_num}", cells, files)
                others = found.setdefault(row.file, [])
                _check_consistent(f"{path}:{reader.line_num}", row, others)
                others.append(row)
                if len(others) > limits.PEERS:
                    raise SourceError(
                        f"{path}:{reader.line_num}: {row.file} has more than {limits.PEERS} rows. "
                        "Delete some"
                    )
    except FileNotFoundError:
        raise SourceError(f"no label file {path}. Pass another with --labels") from None
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise SourceError(f"{path} is not a CSV file: {e}. Save it as CSV in UTF-8") from None
    return found


def _check_columns(path: Path, columns: Sequence[str]) -> None:
    for column in columns:
        if column not in COLUMNS:
            hint = suggest(column, COLUMNS, f"Known are {', '.join(COLUMNS)}")
            raise SourceError(f"{path}:1: unknown column {column!r}. {hint}")
    if missing := [column for column in REQUIRED_COLUMNS if column not in columns]:
        raise SourceError(
            f"{path}:1: no column {', '.join(missing)}. The first line names the columns; "
            f"needed are {', '.join(REQUIRED_COLUMNS)}"
        )
    if len(set(columns)) < len(columns):
        raise SourceError(f"{path}:1: a column appears twice. Delete one")


def _parse_cells(
    where: str, cells: Mapping[str | None, Any], files: Collection[str]
) -> Mapping[str, str]:
    """Return the cells of a line by column name. Each cell and the image must exist."""
    if None in cells or None in cells.values():
        raise SourceError(f"{where}: not as many cells as the header. Fix the line")
    row = {str(name): str(cell).strip() for name, cell in cells.items()}
    if row["file"] not in files:
        hint = suggest(row["file"], files, "Add the image, or delete the line")
        raise SourceError(f"{where}: no image {row['file']!r} in the folder. {hint}")
    return row


def _parse_row(where: str, cells: Mapping[str | None, Any], files: Collection[str]) -> LabelRow:
    row = _parse_cells(where, cells, files)
    split = row.get("split") or None
    if split is not None:
        check_split_name(split, f"{where}: the split")
    source = row.get("source") or "hand"
    if source not in LABEL_SOURCES:
        raise SourceError(f"{where}: source is {source!r}. It must be {', '.join(LABEL_SOURCES)}")
    if not row["peer"]:
        if filled := next(filter(row.get, (*POINT_COLUMNS, *BOX_COLUMNS, *SIGMA_COLUMNS)), None):
            raise SourceError(
                f"{where}: {filled} without a peer. Name the peer, or leave the cells empty"
            )
        return LabelRow(row["file"], "", source=source, split=split)
    box = tuple(_parse_number(where, row, name) for name in BOX_COLUMNS if row.get(name))
    middle = [sum(box[k::2]) / 2 if len(box) == 4 else None for k in (0, 1)]
    u_px, v_px = (
        _parse_number(where, row, name, default)
        for name, default in zip(POINT_COLUMNS, middle, strict=False)
    )
    known = bool(row.get("depth_m"))
    depth_m = _parse_number(where, row, "depth_m") if known else 0.0
    unknown = (0.0, 0.0, 0.0 if known else math.inf)
    sigmas = tuple(
        _parse_number(where, row, *pair) for pair in zip(SIGMA_COLUMNS, unknown, strict=True)
    )
    share = _parse_number(where, row, "visible_share", 0.0)
    if known and depth_m <= 0:
        raise SourceError(
            f"{where}: depth_m is {depth_m:g}; it must be over 0, or empty. Fix the cell"
        )
    _check_values(where, box, share, sigmas)
    row_name = row["file"], row["peer"]
    return LabelRow(*row_name, u_px, v_px, depth_m, box, share, source, split, sigmas)


def _parse_number(
    where: str, row: Mapping[str, str], name: str, default: float | None = None
) -> float:
    cell = row.get(name, "")
    if not cell and default is not None:
        return default
    try:
        value = parse_number(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SourceError(f"{where}: {name} is {cell!r}, not a number. Fix the cell")
    return value


def _check_values(
    where: str, box: tuple[float, ...], share: float, sigmas: tuple[float, ...]
) -> None:
    if box and not (len(box) == 4 and box[0] < box[2] and box[1] < box[3]):
        raise SourceError(
            f"{where}: not a box. {', '.join(BOX_COLUMNS)}: all or none, left < right, top < bottom"
        )
    if not 0 <= share <= 1:
        raise SourceError(f"{where}: visible_share is {share:g}. It must be from 0 to 1")
    if min(sigmas) < 0:
        raise SourceError(f"{where}: a sigma is negative. Fix the cell")


def _check_consistent(where: str, row: LabelRow, others: Sequence[LabelRow]) -> None:
    if others and (not row.peer or not others[0].peer):
        raise SourceError(
            f"{where}: {row.file} has a row with an empty peer, so it may have no other. Delete one"
        )
    if any((row.peer, row.source) == (other.peer, other.source) for other in others):
        raise SourceError(
            f"{where}: {row.file} has {row.peer} from {row.source} already. Delete one row"
        )
    if others and row.split != others[0].split:
        raise SourceError(
            f"{where}: {row.file} is in split {row.split or 'none'} and in "
            f"{others[0].split or 'none'}. Choose one"
        )
