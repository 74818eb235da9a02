"""Recipe of a small pipeline: images, a recording of them, and a trimmed one."""

HEAD = 'kind = "pipeline"\n'
PICTURES = f"""{HEAD}
[[step]]
stage = "sketch"
out = "pictures"
images = 2

[[step]]
stage = "convert"
source = "pictures"
out = "pictures.mcap"
"""
"""First steps of other recipes."""
CHAIN = f"""{PICTURES}
[[step]]
stage = "trim"
recording = "pictures.mcap"
to_s = 0.5
out = "short.mcap"
"""
