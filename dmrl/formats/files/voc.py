"""Pascal VOC sets: an XML file for each picture, in ``Annotations/`` or beside it.

``bndbox`` counts whole pixels from 1, and its last ones are part of the box: ``xmin`` 1 and
``xmax`` 500 are the edges 0 and 500. The split of a picture is that of
``ImageSets/Main/train.txt``, ``val.txt`` or ``test.txt``, else that of its folder.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree

from dmrl.errors import SourceError
from dmrl.formats.base import Content, Format, Options
from dmrl.formats.files.label_csv import LabelRow
from dmrl.formats.files.labelled_pictures import (
    LABELLED_OPTIONS,
    LabelledPicture,
    build_rows,
    build_set_content,
    drop_repeats,
    find_split,
    list_pictures,
    natural_key,
)
from dmrl.guards.bounded_parsing import parse_number, parse_xml
from dmrl.terminal.left_out import leave_out

HEAD_BYTES = 4096
UNREADABLE = "XML files that are not VOC's; their pictures have no labels"


def can_read(source: Path) -> bool:
    """Return whether a folder has an XML file with an annotation."""
    return source.is_dir() and next(_iter_annotation_files(source), None) is not None


def _iter_annotation_files(source: Path) -> Iterator[Path]:
    for path in source.rglob("*.xml"):
        if not path.name.startswith(".") and path.is_file():
            with path.open("rb") as stream:
                if b"<annotation" in stream.read(HEAD_BYTES):
                    yield path


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a set: images split by split, with their labels.

    Parameters
    ----------
    source
        The folder of the set.
    options
        ``names`` of peers by class, ``rate_hz``, ``robot_width_m``, and those of
        `PictureConverter`.

    Raises
    ------
    SourceError
        If no XML file can be read, or there is no picture.
    """
    paths, files = list_pictures(source), sorted(_iter_annotation_files(source), key=natural_key)
    labels = _match_labels(paths, files)
    splits = _read_image_sets(source)
    pictures = []
    for path in paths:
        label = labels.get(path)
        split = splits.get(path.stem) or find_split(path.relative_to(source), {})
        rows, size = (None, None) if label is None else _read_rows(label, path, options)
        pictures.append(LabelledPicture(path, split, rows, size))
    if not any(picture.rows is not None for picture in pictures):
        raise SourceError(f"{source}: no picture has an XML file that can be read. Pass another")
    for lost in sorted({*files} - {*labels.values()}):
        leave_out("XML files without a picture", lost)
    return build_set_content(source, pictures, options)


def _match_labels(paths: Sequence[Path], files: Sequence[Path]) -> dict[Path, Path]:
    """Return the XML file of each picture: of the same name, and in folders of the same names.

    An XML file that is nearer to another picture of the name, such as that of another split, is not
    the picture's.
    """

    def count_shared(one: Path, other: Path) -> int:
        return len({*one.parent.parts} & {*other.parent.parts})

    named: dict[str, tuple[list[Path], list[Path]]] = {}
    for k, path in ((k, path) for k, held in enumerate((paths, files)) for path in held):
        named.setdefault(path.stem, ([], []))[k].append(path)
    found = {}
    for twins, labels in named.values():
        for path in twins if labels else ():
            label = max(labels, key=lambda one: count_shared(one, path))
            if count_shared(label, path) == max(count_shared(label, one) for one in twins):
                found[path] = label
    return found


def _read_image_sets(source: Path) -> dict[str, str]:
    """Return the splits of pictures, by their names without suffix."""
    splits = {}
    for split in ("train", "val", "test"):
        for path in source.glob(f"**/ImageSets/Main/{split}.txt"):
            text = path.read_text(encoding="utf-8", errors="replace")
            splits.update({line.split()[0]: split for line in text.splitlines() if line.split()})
    return splits


def _read_rows(
    label: Path, picture: Path, options: Options
) -> tuple[list[LabelRow] | None, tuple[float, float] | None]:
    """Return the labels of a picture and the size that they refer to; None, None: unreadable."""
    try:
        root = parse_xml(label.read_bytes())
        width, height = (
            parse_number(root.findtext(f"size/{side}") or "0") for side in ("width", "height")
        )
        boxes = drop_repeats([_parse_box(one) for one in root.findall("object")], label)
        rows = build_rows(picture.name, boxes, options.names)
    except (OSError, ValueError) as e:
        leave_out(UNREADABLE, f"{label}: {e}")
        return None, None
    return rows, (width, height) if width and height else None


def _parse_box(one: ElementTree.Element) -> tuple[str, tuple[float, float, float, float]]:
    """Return the class of an object, and its left, top, right and bottom edge."""
    xmin, ymin, xmax, ymax = (
        parse_number(one.findtext(f"bndbox/{name}") or "nan")
        for name in ("xmin", "ymin", "xmax", "ymax")
    )
    name = (one.findtext("name") or "").strip() or "class"
    return name, (xmin - 1, ymin - 1, xmax, ymax)


FORMAT = Format("voc", "a Pascal VOC set", can_read, load_content, LABELLED_OPTIONS)
