"""Inconsistent MCAP files with correct checksums, written byte by byte.

Each file has up to three faults, such as wrong offsets, statistics or times. Checksums are computed
last, so that none of them reveals a fault.
"""

import struct
from collections import Counter
from collections.abc import Callable
from random import Random

from .mcap_layout import MESSAGE, UNKNOWN, Chunk, Layout, Message, Writer, draw_layout

Fault = Callable[[Random, Layout], None]
FAULTS: dict[str, Fault] = {}


def add_fault(put: Fault) -> Fault:
    """Register a function that puts a fault into a layout, under its name."""
    FAULTS[put.__name__] = put
    return put


def pick_chunk(rng: Random, layout: Layout) -> Chunk:
    """Return a random chunk of the layout, or one outside it if it has none."""
    return rng.choice(layout.chunks or [Chunk([])])


def change_entry(rng: Random, layout: Layout, change: Callable[[list], None]) -> None:
    """Change the entries of one random message index when the file is written."""

    def put(entries: dict[int, list[tuple[int, int]]]) -> None:
        if full := sorted(number for number, own in entries.items() if own):
            change(entries[rng.choice(full)])

    pick_chunk(rng, layout).change_entries.append(put)


@add_fault
def entries_point_elsewhere(rng: Random, layout: Layout) -> None:
    by = rng.choice([1, 9, 31, -9, 1 << 40])

    def move(own: list[tuple[int, int]]) -> None:
        for k in range(len(own)):
            if rng.random() < 0.5:
                own[k] = own[k][0], max(0, own[k][1] + by)

    change_entry(rng, layout, move)


@add_fault
def entries_repeat(rng: Random, layout: Layout) -> None:
    change_entry(rng, layout, lambda own: own.append(rng.choice(own)))


@add_fault
def entries_repeat_in_place_of_others(rng: Random, layout: Layout) -> None:
    change_entry(rng, layout, lambda own: own.__setitem__(0, own[-1]))


@add_fault
def entries_are_missing(rng: Random, layout: Layout) -> None:
    change_entry(rng, layout, lambda own: own.pop(rng.randrange(len(own))))


@add_fault
def entries_are_permuted(rng: Random, layout: Layout) -> None:
    change_entry(rng, layout, rng.shuffle)


@add_fault
def entries_have_other_times(rng: Random, layout: Layout) -> None:
    later = rng.choice([1, 7, 1 << 63])
    change_entry(rng, layout, lambda own: own.__setitem__(0, (own[0][0] + later, own[0][1])))


@add_fault
def a_message_index_is_missing(rng: Random, layout: Layout) -> None:
    def drop(entries: dict[int, list[tuple[int, int]]]) -> None:
        if entries:
            del entries[rng.choice(sorted(entries))]

    pick_chunk(rng, layout).change_entries.append(drop)


@add_fault
def a_message_is_in_no_index_and_no_statistics(rng: Random, layout: Layout) -> None:
    chunk = pick_chunk(rng, layout)
    if not chunk.messages:
        return
    lost = chunk.messages[-1].channel

    def drop(entries: dict[int, list[tuple[int, int]]]) -> None:
        if entries.get(lost):
            entries[lost].pop()

    chunk.change_entries.append(drop)

    def lower(told: dict[str, int], counts: Counter[int]) -> None:
        told["messages"] -= 1
        counts[lost] -= 1

    layout.change_statistics.append(lower)


@add_fault
def a_chunk_index_omits_a_channel(rng: Random, layout: Layout) -> None:
    def drop(offsets: dict[int, int]) -> None:
        if offsets:
            del offsets[rng.choice(sorted(offsets))]

    pick_chunk(rng, layout).change_offsets.append(drop)


@add_fault
def a_chunk_index_swaps_channels(rng: Random, layout: Layout) -> None:
    def swap(offsets: dict[int, int]) -> None:
        places = [*offsets.values()]
        offsets.update(zip(offsets, places[1:] + places[:1], strict=True))

    pick_chunk(rng, layout).change_offsets.append(swap)


@add_fault
def a_chunk_index_points_elsewhere(rng: Random, layout: Layout) -> None:
    by = rng.choice([1, -9, 15, 1 << 40])
    pick_chunk(rng, layout).change_offsets.append(
        lambda offsets: offsets.update({n: max(0, at + by) for n, at in offsets.items()})
    )


@add_fault
def a_chunk_is_listed_elsewhere(rng: Random, layout: Layout) -> None:
    pick_chunk(rng, layout).shift = rng.choice([1, 9, -9])


@add_fault
def a_chunk_is_not_listed(rng: Random, layout: Layout) -> None:
    pick_chunk(rng, layout).listed = 0
    if rng.random() < 0.5:
        layout.change_statistics.append(lambda told, _: told.update(chunks=told["chunks"] - 1))


@add_fault
def a_chunk_is_listed_twice(rng: Random, layout: Layout) -> None:
    pick_chunk(rng, layout).listed = 2
    if rng.random() < 0.5:
        layout.change_statistics.append(lambda told, _: told.update(chunks=told["chunks"] + 1))


@add_fault
def times_of_a_chunk_lie(rng: Random, layout: Layout) -> None:
    chunk = pick_chunk(rng, layout)
    times = [m.time for m in chunk.messages] or [0]
    low, high = min(times), max(times)
    lie = rng.choice(
        [(low + 1, high), (low, max(0, high - 1)), (0, 0), (high + 7, high + 9), (low, high + 50)]
    )
    if rng.random() < 0.5:
        chunk.times = lie
    else:
        chunk.index_times = lie


@add_fault
def a_whole_chunk_lies_about_its_times(rng: Random, layout: Layout) -> None:
    chunk = pick_chunk(rng, layout)
    by = rng.choice([40, 1_000])
    times = [m.time for m in chunk.messages] or [0]
    chunk.times = min(times) + by, max(times) + by
    chunk.change_entries.append(
        lambda entries: entries.update(
            {n: [(t + by, at) for t, at in own] for n, own in entries.items()}
        )
    )


@add_fault
def statistics_count_wrong(rng: Random, layout: Layout) -> None:
    by = rng.choice([1, -1, 5])
    part, channel = rng.random(), rng.choice([*layout.channels, 77])

    def change(told: dict[str, int], counts: Counter[int]) -> None:
        if part < 0.7:
            told["messages"] += by
        if part > 0.3:
            counts[channel] += by

    layout.change_statistics.append(change)


@add_fault
def statistics_count_another_channel(rng: Random, layout: Layout) -> None:
    one, other = rng.choice([*layout.channels]), rng.choice([*layout.channels])

    def change(_: dict[str, int], counts: Counter[int]) -> None:
        counts[one] += 1
        counts[other] -= 1

    layout.change_statistics.append(change)


@add_fault
def statistics_have_other_times(rng: Random, layout: Layout) -> None:
    name, by = rng.choice(["start", "end"]), rng.choice([1, -1, 1_000, -1_000, (1 << 63)])
    layout.change_statistics.append(lambda told, _: told.update({name: told[name] + by}))


@add_fault
def statistics_count_other_records(rng: Random, layout: Layout) -> None:
    name = rng.choice(["schemas", "channels", "attachments", "metadata", "chunks"])
    by = rng.choice([1, -1])
    layout.change_statistics.append(lambda told, _: told.update({name: told[name] + by}))


@add_fault
def the_summary_starts_elsewhere(rng: Random, layout: Layout) -> None:
    kind, pick, by = rng.random(), rng.random(), rng.choice([1, -1, 9, 1 << 40])

    def move(start: int, starts: list[int]) -> int:
        if kind < 0.6:
            return starts[int(pick * len(starts))]
        return 0 if kind < 0.8 else start + by

    layout.change_summary_start = move


@add_fault
def times_are_at_the_limits(rng: Random, layout: Layout) -> None:
    if messages := layout.messages:
        one = rng.choice(messages)
        time = rng.choice([0, 1, 2**63 - 2, 2**63 - 1, 2**63, 2**64 - 1])
        if rng.random() < 0.3:
            one.publish = time
        else:
            one.time = time


@add_fault
def opcodes_are_unknown(rng: Random, layout: Layout) -> None:
    opcode, where = rng.choice(UNKNOWN), rng.random()
    if where < 0.4:
        pick_chunk(rng, layout).unknown = opcode
    elif where < 0.7:
        layout.parts.insert(rng.randint(0, len(layout.parts)), -opcode)
    else:
        layout.unknown_in_summary = opcode


@add_fault
def compression_is_named_otherwise(rng: Random, layout: Layout) -> None:
    pick_chunk(rng, layout).named = rng.choice(["zstd", "lz4", "none", "ZSTD", "lz4 ", "brotli"])


@add_fault
def a_chunk_has_another_size(rng: Random, layout: Layout) -> None:
    pick_chunk(rng, layout).size_more = rng.choice([1, -1, 100])


@add_fault
def message_indexes_have_another_length(rng: Random, layout: Layout) -> None:
    pick_chunk(rng, layout).length_more = rng.choice([1, -1, 9, -16, -31])


@add_fault
def a_channel_is_renamed(rng: Random, layout: Layout) -> None:
    layout.summary_topic = True


@add_fault
def a_channel_is_not_defined(rng: Random, layout: Layout) -> None:
    if chunks := [chunk for chunk in layout.chunks if chunk.definitions]:
        rng.choice(chunks).definitions.pop()


@add_fault
def a_schema_is_missing(rng: Random, layout: Layout) -> None:
    if layout.schemas:
        del layout.schemas[rng.choice([*layout.schemas])]


@add_fault
def messages_follow_the_end(rng: Random, layout: Layout) -> None:
    layout.after_end.append(Message(rng.choice([*layout.channels]), 7, 7, b"late"))


@add_fault
def extras_are_listed_elsewhere(rng: Random, layout: Layout) -> None:
    if rng.random() < 0.5:
        layout.shift_extra = rng.choice([1, -1, 9])
    else:
        layout.repeat_extra = rng.choice([0, 2])


@add_fault
def messages_overlap(rng: Random, layout: Layout) -> None:
    """Put a message record into a payload and an entry for it into an index."""
    chunk = pick_chunk(rng, layout)
    if not chunk.messages:
        return
    inner = Message(chunk.messages[0].channel, chunk.messages[0].time, 0, b"inner").body()
    chunk.messages[0].data = struct.pack("<BQ", MESSAGE, len(inner)) + inner

    def point(entries: dict[int, list[tuple[int, int]]]) -> None:
        own = entries.get(chunk.messages[0].channel)
        if not own:
            return
        shifted = own[0][0], own[0][1] + 31
        if rng.random() < 0.5:
            own[0] = shifted
        else:
            own.append(shifted)

    chunk.change_entries.append(point)


def draw_file(rng: Random) -> tuple[bytes, tuple[str, ...]]:
    """Draw a file; return it with the names of its faults.

    The last name is "padded" if records have trailing bytes, which the specification allows.
    """
    layout = draw_layout(rng)
    names = tuple(rng.sample(sorted(FAULTS), rng.choice([0, 1, 1, 1, 2, 3])))
    for name in names:
        FAULTS[name](rng, layout)
    return Writer(layout).write(), names + ("padded",) * (layout.padding > 0)
