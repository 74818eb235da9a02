"""Define the limits on the resources that a file may request, all in one place.

Files are untrusted, and a few bytes can request a lot: 200 kB of zstd decompress to 6 GB, a
small PNG to 170 million pixels. A command that reads needs at most about 1 GB and 30 s more than
the size of its files explains. Larger requests are refused before allocation.
"""

MB = 1_000_000

UNPACKED_BYTES = 128 * MB
"""Largest chunk of a recording, decompressed. dmrl's own have 256 KiB and a message."""

UNPACKED_TIMES = 100
"""A recording may decompress to `UNPACKED_BYTES` plus this many times its own size.

dmrl's own topics reach about 20; images reach 1.
"""

MEMORY_BYTES = 500 * MB
"""Memory that a library may use to read a whole file (see `dmrl.guards.memory`), bytes."""

MEMORY_TIMES = 10
"""A library may use `MEMORY_BYTES` plus this many times the size of the file."""

ANSWER_BYTES = 4 * MB
"""Answer of a server of buckets that is no object. A page of 1,000 long keys has 3.5 MB."""

LISTED_FILES = 200_000
"""Objects of a listing."""

LISTING_S, LISTED_PER_S = 30.0, 100
"""Timeout of a listing: a fixed part, seconds, and a minimum rate, objects per second."""

TENSOR_BYTES = 300 * MB
"""Tensors that an ONNX file of a few kB holds at a time, for one image."""

NETWORK_PRODUCTS = 100_000 * MB
"""Multiplications of an ONNX file for one image: some seconds. `dmrl-nano` has 50 million."""

TOPICS = 2_000
"""Channels of a recording, and schemas."""

NAME_CHARACTERS = 1_000
"""Length of the name of a topic or a message type."""

LARGE_PIXELS = 2 * MB
"""Size from which an image counts towards `DECODED_PIXELS`.

All such images that a process decodes may have `DECODED_PIXELS`, and `UNPACKED_TIMES` pixels
per byte. Camera images have about 3 pixels per byte; only blank images exceed the limit.
"""

HEADER_BYTES = 65_536
"""Header of a PPM file, with its comments."""

VARIABLES = 1_000
"""Variables of an event in a log, and columns of a table."""

LINE_CHARACTERS = 100_000
"""Length of a line of numbers in a log; enough for `VARIABLES`."""

PIXELS = 64 * MB
"""Photo that is scaled down: 8,000 x 8,000. With its copies it takes 0.7 GB."""

FRAME_PIXELS = 9 * MB
"""Image of a recording, and images that are in memory together: 3840 x 2160.

A blank image of that size has 30 kB, and a network needs 50 bytes for each pixel.
"""

SIDE_PX = 65_535
"""Width or height of an image, the largest of a JPEG. Decoders allocate memory for every row."""

DECODED_PIXELS = 1_000 * MB
"""Pixels of an image times its scans. A progressive JPEG of a few kB can have thousands."""

PEERS = 1_000
"""Labels of one image of a dataset."""

DEPTH = 200
"""Nesting of tables and lists in JSON and TOML."""

TOML_CHARACTERS = 100_000
"""Length of a recipe or a camera file. The time for long dotted keys grows with their square."""

TEXT_BYTES = 50 * MB
"""Size of a text file that is read whole: labels, class names, lists of pictures."""

XML_BYTES = 10 * MB
"""Size of an XML file of labels, or of a camera."""

STEPS = 10_000
"""Steps of a pipeline after ``[each]`` is expanded. The longest that ships has 1,805."""

GATHERED_VALUES = 200_000
"""Values that all steps of a pipeline collect."""

STEP_CHARACTERS = 50 * MB
"""Length of all steps of a pipeline together."""

ANCESTORS = 64
"""Depth of a provenance. Older ancestors keep their hash only."""


def max_unpacked_bytes(size: int) -> int:
    """Return the limit for the decompressed size of a recording of ``size`` bytes."""
    return UNPACKED_BYTES + UNPACKED_TIMES * size


def max_archive_bytes(size: int) -> int:
    """Return the limit for the decompressed size of an archive of ``size`` bytes, all in memory."""
    return UNPACKED_BYTES + MEMORY_TIMES * size


def max_tensor_bytes(size: int) -> int:
    """Return the limit for the tensors of a network whose file has ``size`` bytes."""
    return TENSOR_BYTES + MEMORY_TIMES * size


def max_memory_bytes(size: int) -> int:
    """Return the memory that a library may use to read a file of ``size`` bytes."""
    return MEMORY_BYTES + MEMORY_TIMES * size
