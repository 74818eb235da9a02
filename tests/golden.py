"""Hash the decoded outputs of the main commands on fixed inputs, to detect changes of behaviour.

    make golden                  compare with tests/golden.json
    make golden ARGS="--write"   write tests/golden.json again

Every command runs with one numeric thread. A hash covers decoded content: messages, schemas,
pixels, rows and text, without file times, checksums of inputs and the version of dmrl.
Floating-point results differ between processors: write the hashes on the machine that compares.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from mcap.reader import make_reader
from PIL import Image

HASHES = Path(__file__).with_name("golden.json")
COMMANDS = """
sketch pictures --images 24 --seed 3
convert pictures pictures.mcap
fly fly_in_view flight.mcap --duration-s 20 --seed 5 --camera --camera-rate-hz 2
fly fly_swarm swarm.mcap --robots 3 --duration-s 15
convert swarm.mcap tables --to csv
label flight.mcap labelled.mcap
label flight.mcap ekf.mcap --method ekf
label swarm.mcap swarm_labelled.mcap --method swarm
predict dmrl-nano flight.mcap found.mcap --backend onnx
label found.mcap refined.mcap --detections
track found.mcap tracks.mcap
dataset labelled.mcap dataset --split none
dataset pictures.mcap drawn
quantize dmrl-nano drawn int8
export int8 exported
trim labelled.mcap trimmed.mcap --from-s 5 --to-s 12
merge swarm.mcap labelled.mcap merged.mcap
index .
"""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
VOLATILE = re.compile(
    r"sha256|version|modified|created|time|host|elapsed|_s$|path|bytes|librar|stamp|inputs"
)
"""JSON keys and columns of the catalogue that depend on when and where a file was made."""


def run_commands(folder: Path) -> None:
    """Run `COMMANDS` in a folder; exit with the output of the first that fails."""
    for line in COMMANDS.split("\n"):
        if words := line.split():
            print("dmrl", line, file=sys.stderr)
            command = [sys.executable, "-m", "dmrl.cli", *words]
            environment = {**os.environ, **ONE_THREAD}
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, check=False
            )
            if done.returncode:
                sys.exit(f"dmrl {line}: exit {done.returncode}\n{done.stderr}")


def iter_mcap_parts(path: Path) -> Iterator[bytes]:
    """Yield the schemas, messages, attachments and settings of a recording, sorted in time."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages():
            times = f"{message.log_time} {message.publish_time} {message.sequence}"
            name = schema.name if schema else ""
            yield f"{channel.topic} {channel.message_encoding} {name} {times}".encode()
            yield message.data
        summary = reader.get_summary()
        for schema in sorted(summary.schemas.values(), key=lambda s: s.name) if summary else ():
            yield schema.name.encode() + schema.data
        for attachment in reader.iter_attachments():
            yield attachment.name.encode() + attachment.data
        for metadata in reader.iter_metadata():
            kept = {
                k: v for k, v in metadata.metadata.items() if k in ("stage", "settings", "seed")
            }
            yield f"{metadata.name} {sorted(kept.items())}".encode()


def drop_volatile(value: Any) -> Any:
    """Return a JSON value without the keys that change from run to run."""
    if isinstance(value, dict):
        return {k: drop_volatile(v) for k, v in sorted(value.items()) if not VOLATILE.search(k)}
    return [drop_volatile(v) for v in value] if isinstance(value, list) else value


def iter_table_parts(table: pa.Table) -> Iterator[bytes]:
    """Yield the names and values of the columns of a table."""
    for name in table.column_names:
        if not VOLATILE.search(name) or name == "log_time":
            yield name.encode() + repr(table[name].to_pylist()).encode()


def iter_parts(path: Path) -> Iterator[bytes]:
    """Yield the decoded content of a file."""
    if path.suffix == ".mcap":
        yield from iter_mcap_parts(path)
    elif path.suffix in (".png", ".jpg", ".jpeg"):
        yield Image.open(path).tobytes()
    elif path.suffix == ".arrow":
        yield from iter_table_parts(pa.ipc.open_stream(path).read_all())
    elif path.suffix == ".parquet":
        yield from iter_table_parts(pq.read_table(path))
    elif path.suffix == ".json":
        yield json.dumps(drop_volatile(json.loads(path.read_text()))).encode()
    elif path.suffix in (".npz", ".svg", ".onnx", ".md", ".html"):
        yield b""  # these contain times or prose; the data behind them is hashed in other files
    else:
        yield path.read_bytes()


def hash_folder(folder: Path) -> dict[str, str]:
    """Return the hash of every file below a folder, by its relative path."""
    hashes = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        total = hashlib.sha256()
        for part in iter_parts(path):
            total.update(part)
        hashes[str(path.relative_to(folder))] = total.hexdigest()[:16]
    return hashes


def main() -> None:
    """Run the commands, then write the hashes or print every file that differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write tests/golden.json")
    write = parser.parse_args().write
    with tempfile.TemporaryDirectory() as folder:
        run_commands(Path(folder))
        hashes = hash_folder(Path(folder))
    if write:
        HASHES.write_text(json.dumps(hashes, indent=1) + "\n")
        return
    expected = json.loads(HASHES.read_text())
    differing = sorted(n for n in {*hashes, *expected} if hashes.get(n) != expected.get(n))
    if differing:
        sys.exit("these outputs differ: " + ", ".join(differing))
    print(f"{len(hashes)} files have the content of tests/golden.json")


if __name__ == "__main__":
    main()
