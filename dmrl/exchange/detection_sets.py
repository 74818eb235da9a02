"""Write datasets as YOLO, COCO and WebDataset folders. All are text, JSON and tar files."""

import io
import json
import tarfile
from collections import Counter, defaultdict
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dmrl.datasets.layout import format_json
from dmrl.exchange.dataset_rows import ExportRow, ExportRows, to_attributes
from dmrl.terminal.progress import say

SHARD_IMAGES = 1000
"""Images of a tar file, some 100 MB of PNGs of 320 x 224 pixels."""


def write_yolo(rows: ExportRows, folder: Path) -> dict[str, int]:
    """Write ``data.yaml``, ``images/<split>`` and ``labels/<split>``; return images by split."""
    numbers = {name: k for k, name in enumerate(rows.classes)}
    counts: Counter[str] = Counter()
    for row in rows.iter_boxed():
        lines = [_to_yolo_line(peer, numbers, row.size_px) for peer in row.peers]
        _write(folder / "images" / row.split / f"{row.name}.png", row.png)
        _write(folder / "labels" / row.split / f"{row.name}.txt", "".join(lines).encode())
        counts[row.split] += 1
    stated = {split: f"images/{split}" for split in counts}
    if stated and "val" not in stated:
        # Trainers refuse a set without one.
        stated["val"] = stated.get("test", next(iter(stated.values())))
        say(f"data.yaml names {stated['val']} as val too")
    named = {"names": rows.classes, **stated}
    # JSON is YAML.
    _write(folder / "data.yaml", (json.dumps(named, indent=1) + "\n").encode())
    return dict(counts)


def _to_yolo_line(peer: dict[str, Any], numbers: dict[str, int], size_px: tuple[int, int]) -> str:
    left, top, right, bottom = peer["box_px"]
    width, height = size_px
    shares = (left + right) / 2 / width, (top + bottom) / 2 / height
    sides = (right - left) / width, (bottom - top) / height
    return " ".join([str(numbers[peer["class"]]), *(f"{v:.9f}" for v in (*shares, *sides))]) + "\n"


def write_coco(rows: ExportRows, folder: Path) -> dict[str, int]:
    """Write ``<split>/`` and ``annotations/instances_<split>.json``; return images by split."""
    numbers = {name: k for k, name in enumerate(rows.classes, 1)}
    images: dict[str, list[dict[str, Any]]] = defaultdict(list)
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows.iter_boxed():
        width, height = row.size_px
        number = len(images[row.split]) + 1
        name = f"{row.name}.png"
        about = {"recording": row.source, "robot": row.robot, "log_time": row.log_time}
        size = {"width": width, "height": height}
        images[row.split].append({"id": number, "file_name": name, **size, **about})
        _write(folder / row.split / name, row.png)
        for peer in row.peers:
            left, top, right, bottom = peer["box_px"]
            place = {"bbox": [left, top, right - left, bottom - top], "iscrowd": 0}
            place["area"] = (right - left) * (bottom - top)
            kind = {"image_id": number, "category_id": numbers[peer["class"]]}
            attributes = {k: v for k, v in to_attributes(peer).items() if k != "box_px"}
            own = {"id": len(found[row.split]) + 1, **kind, **place, "attributes": attributes}
            found[row.split].append(own)
    categories = [{"id": k, "name": name} for name, k in numbers.items()]
    for split, mine in images.items():
        document = {"images": mine, "annotations": found[split], "categories": categories}
        path = folder / "annotations" / f"instances_{split}.json"
        _write(path, format_json(document).encode())
    return {split: len(mine) for split, mine in images.items()}


def write_webdataset(rows: ExportRows, folder: Path) -> dict[str, int]:
    """Write ``<split>-000000.tar``, ... of a PNG and a JSON each; return images by split."""
    counts: Counter[str] = Counter()
    with ExitStack() as opened:
        for row in rows:
            if counts[row.split] % SHARD_IMAGES == 0:
                opened.close()
                shard = f"{row.split}-{counts[row.split] // SHARD_IMAGES:06d}.tar"
                archive = opened.enter_context(
                    tarfile.open(folder / shard, "w", format=tarfile.GNU_FORMAT)
                )
            _add(archive, f"{row.name}.json", json.dumps(_describe(row), sort_keys=True).encode())
            _add(archive, f"{row.name}.png", row.png)
            counts[row.split] += 1
    return dict(counts)


def _describe(row: ExportRow) -> dict[str, Any]:
    width, height = row.size_px
    peers = [to_attributes(peer) for peer in row.peers]
    about = {"recording": row.source, "robot": row.robot, "log_time": row.log_time}
    return {"peers": peers, "width": width, "height": height, "split": row.split, **about}


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(data)
    archive.addfile(member, io.BytesIO(data))


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
