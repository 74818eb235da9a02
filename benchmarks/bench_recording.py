"""Compare dmrl with mcap, foxglove-sdk and rerun for writing, reading and copying recordings.

Run as ``python benchmarks/bench_recording.py [--rounds 5] [--json FILE]``, after
``pip install --group bench``. All packages do the same work in one process, in turns. Figures are
medians over rounds of the CPU time of all threads; ratios are taken within each round. The
recordings are flights of `dmrl fly`: two robots with cameras (17 topics) and ten robots without
(211 topics).
"""

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import foxglove
import numpy as np
from foxglove import Channel as FoxgloveChannel
from foxglove import Schema as FoxgloveSchema
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from rerun.chunk import McapReader

from dmrl.messages import message_class, serialize_schema
from dmrl.recording import Provenance, RecordingWriter, iter_columns, read_summary, rewrite
from dmrl.stages import fly

TOPIC, KIND = "/cf1/attitude", "dmrl.v1.Attitude"
MADE = Provenance("bench")
MESSAGES = 200_000
Work = Callable[[Path, Path], object]


def make_flights(folder: Path) -> dict[str, Path]:
    """Simulate the recordings that are read and copied, unless they exist; return their paths."""
    found = {"17 topics, cameras": folder / "pair.mcap", "211 topics": folder / "swarm.mcap"}
    pair = fly.Settings(2, 50.0, camera=True, camera_rate_hz=5.0, seed=1)
    for path, settings in zip(found.values(), (pair, fly.Settings(10, 20.0, seed=1)), strict=True):
        if not path.exists():
            fly.run(path, settings)
    return found


ROLL, PITCH, YAW = np.random.default_rng(0).normal(size=(3, MESSAGES))
TIMES = np.arange(MESSAGES) * 10_000_000


def iter_messages() -> Any:
    """Yield time and message, built one at a time as by a driver."""
    attitude = message_class("Attitude")
    rows = zip(TIMES.tolist(), ROLL.tolist(), PITCH.tolist(), YAW.tolist(), strict=True)
    for time_ns, roll, pitch, yaw in rows:
        yield time_ns, attitude(roll_rad=roll, pitch_rad=pitch, yaw_rate_radps=yaw)


def write_dmrl(_: Path, out: Path) -> None:
    """Write the messages one by one."""
    with RecordingWriter(out, MADE) as sink:
        for time_ns, made in iter_messages():
            sink.write(time_ns, TOPIC, made)


def write_columns(_: Path, out: Path) -> None:
    """Write the same recording from arrays, 10,000 messages at a time."""
    fields = {"roll_rad": ROLL, "pitch_rad": PITCH, "yaw_rate_radps": YAW}
    with RecordingWriter(out, MADE) as sink:
        for part in np.array_split(np.arange(MESSAGES), MESSAGES // 10_000):
            own = {name: values[part] for name, values in fields.items()}
            sink.write_columns(TOPIC, message_class("Attitude"), TIMES[part], own)


def write_mcap(_: Path, out: Path) -> None:
    """Write the messages with mcap's own writer."""
    with out.open("wb") as stream:
        writer = Writer(stream, chunk_size=256 * 1024)
        writer.start()
        schema = writer.register_schema(KIND, "protobuf", serialize_schema("Attitude"))
        channel = writer.register_channel(TOPIC, "protobuf", schema)
        for time_ns, made in iter_messages():
            writer.add_message(channel, time_ns, made.SerializeToString(), time_ns)
        writer.finish()


def write_foxglove(_: Path, out: Path) -> None:
    """Write the messages with foxglove-sdk, which is written in Rust."""
    context = foxglove.Context()
    schema = FoxgloveSchema(name=KIND, encoding="protobuf", data=serialize_schema("Attitude"))
    with foxglove.open_mcap(out, context=context):
        channel = FoxgloveChannel(
            TOPIC, schema=schema, message_encoding="protobuf", context=context
        )
        for time_ns, made in iter_messages():
            channel.log(made.SerializeToString(), log_time=time_ns)


def build_only(_: Path, out: Path) -> None:
    """Build and serialise the messages without writing them; every writer has this cost."""
    out.write_bytes(b"")
    for _time_ns, made in iter_messages():
        made.SerializeToString()


def read_dmrl(path: Path, _: Path) -> int:
    """Read one topic as Arrow columns; return the number of messages."""
    return sum(batch.num_rows for batch in iter_columns(path, TOPIC))


def read_mcap(path: Path, _: Path) -> int:
    """Read one topic as Python objects; return the number of messages."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(topics=[TOPIC]))


def read_rerun(path: Path, _: Path) -> int:
    """Read one topic as rerun's Arrow chunks; return the number of rows."""
    reader = McapReader(path, include_topic_regex=[f"^{TOPIC}$"])
    return sum(chunk.num_rows for chunk in reader.stream())


def copy_dmrl(path: Path, out: Path) -> None:
    """Verify and copy a whole recording, as by a stage that adds topics to it."""
    rewrite(path, out, MADE, without=())


def copy_mcap(path: Path, out: Path) -> None:
    """Copy a recording with mcap's reader and writer."""
    with path.open("rb") as source, out.open("wb") as sink:
        writer, numbers = Writer(sink, chunk_size=256 * 1024), dict[int, int]()
        writer.start()
        found = make_reader(source, validate_crcs=True).iter_messages(log_time_order=False)
        for schema, channel, one in found:
            if channel.id not in numbers and schema is not None:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind
                )
            writer.add_message(numbers[channel.id], one.log_time, one.data, one.publish_time)
        writer.finish()


def run_rounds(work: dict[str, Work], path: Path, out: Path, rounds: int) -> dict[str, list[float]]:
    """Run all programs in turns; return the CPU seconds of each by round."""
    spent: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds):
        for name, run in work.items():
            begun = time.process_time()
            run(path, out)
            spent[name].append(time.process_time() - begun)
            out.unlink(missing_ok=True)
    return spent


def build_rows(
    spent: dict[str, list[float]], what: str, count: int, size: int
) -> list[dict[str, Any]]:
    """Return a row for each program: microseconds per message, and their ratio to dmrl's."""
    ours = next(iter(spent.values()))
    return [
        {
            "what": what,
            "who": name,
            "us_a_message": median(seconds) / count * 1e6,
            "mb_a_second": size / median(seconds) / 1e6,
            "ratio": median(other / own for other, own in zip(seconds, ours, strict=True)),
        }
        for name, seconds in spent.items()
    ]


def measure(folder: Path, rounds: int) -> list[dict[str, Any]]:
    """Measure everything; return all rows of the table."""
    out, found = folder / "out.mcap", list[dict[str, Any]]()
    writers: dict[str, Work] = {
        "dmrl, columns": write_columns,
        "dmrl": write_dmrl,
        "building alone": build_only,
        "mcap": write_mcap,
        "foxglove-sdk": write_foxglove,
    }
    readers = {"dmrl": read_dmrl, "mcap": read_mcap, "rerun": read_rerun}
    spent = run_rounds(writers, folder, out, rounds)
    found += build_rows(spent, "write attitudes", MESSAGES, 58 * MESSAGES)
    for name, path in make_flights(folder).items():
        held, size = read_summary(path), path.stat().st_size
        assert read_dmrl(path, out) == read_mcap(path, out) == held.topics[TOPIC].count
        spent = run_rounds(readers, path, out, rounds)
        found += build_rows(spent, f"read a topic of {name}", held.topics[TOPIC].count, size)
        spent = run_rounds({"dmrl": copy_dmrl, "mcap": copy_mcap}, path, out, rounds)
        found += build_rows(spent, f"copy {name}", held.count, size)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="folder of the recordings; default: temporary")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as spare:
        found = measure(arguments.folder or Path(spare), arguments.rounds)
    print(f"{platform.platform()}, Python {platform.python_version()}")
    print(f"{'':40} {'':16} {'us/message':>11} {'MB/s':>8} {'ratio':>7}")
    for row in found:
        print(
            f"{row['what']:40} {row['who']:16} {row['us_a_message']:11.2f} "
            f"{row['mb_a_second']:8.1f} {row['ratio']:7.2f}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
