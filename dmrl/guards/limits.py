"""Budgets: how much a file may ask for, in one place.

Files come from strangers, and a few bytes can ask for a lot: 200 kB of zstd unpack to 6 GB, a
small PNG to 170 million pixels. A command that reads takes at most about 1 GB and 30 s more than
the size of its files explains; what asks for more is refused before it is made.
"""

MB = 1_000_000

UNPACKED_BYTES = 128 * MB
"""What a chunk of a recording may unpack to; dmrl's own hold 256 KiB and a message."""

UNPACKED_TIMES = 100
"""A recording may unpack to `UNPACKED_BYTES`, and this many times its own size. The most that
dmrl's own topics reach is about 20; pictures reach 1."""

MEMORY_BYTES = 500 * MB
"""What a library may take to read a file as a whole (see `dmrl.guards.memory`)."""

MEMORY_TIMES = 10
"""It may take `MEMORY_BYTES`, and this many times the file's own size."""

TOPICS = 2_000
"""Channels of a recording, and schemas."""

NAME_CHARACTERS = 1_000
"""Of a topic or a message type."""

LARGE_PIXELS = 2 * MB
"""Of a picture that counts: all large ones that a process decodes may have `DECODED_PIXELS`, and
`UNPACKED_TIMES` as many as they have bytes. Cameras reach about 3; only blank pictures are over."""

HEADER_BYTES = 65_536
"""Of a PPM, comments among them."""

VARIABLES = 1_000
"""Of an event of a log, and columns of a table that is one."""

LINE_CHARACTERS = 100_000
"""Of a line of numbers in a log: `VARIABLES` and more."""

PIXELS = 64 * MB
"""Of a photo, which is scaled down: 8,000 x 8,000. With its copies that is 0.7 GB."""

FRAME_PIXELS = 9 * MB
"""Of an image of a recording, and of images that are held together: 3840 x 2160. A blank one has
30 kB, and a network takes 50 bytes for each of its pixels."""

SIDE_PX = 65_535
"""Of a picture's width or height, a JPEG's largest; decoders keep a place for every row."""

DECODED_PIXELS = 1_000 * MB
"""Of a picture, each of its scans counted: a progressive JPEG of a few kB can have thousands."""

PEERS = 1_000
"""Labels of one image of a dataset."""

DEPTH = 200
"""Of JSON and TOML: how many tables and lists stand in each other."""

TOML_CHARACTERS = 100_000
"""Of a recipe or a camera file; long dotted keys take a time that grows with their square."""

STEPS = 10_000
"""Of a pipeline, after ``[each]`` is written out; the longest that ships has 1,805."""

GATHERED = 200_000
"""Values that all steps of a pipeline gather."""

STEP_CHARACTERS = 50 * MB
"""Of all steps of a pipeline together."""

ANCESTORS = 64
"""How deep a provenance is told: older ancestors keep their hash and lose their story."""


def unpacked_bytes(size: int) -> int:
    """What a recording of ``size`` bytes may unpack to."""
    return UNPACKED_BYTES + UNPACKED_TIMES * size


def archive_bytes(size: int) -> int:
    """What an archive of arrays of ``size`` bytes may unpack to; all of it is in memory."""
    return UNPACKED_BYTES + MEMORY_TIMES * size


def memory_bytes(size: int) -> int:
    """What a library may take to read a file of ``size`` bytes as a whole."""
    return MEMORY_BYTES + MEMORY_TIMES * size
