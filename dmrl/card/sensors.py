"""What recordings hold besides pictures, and which cameras took those: words for a card."""

from collections.abc import Iterable
from itertools import islice

from dmrl import topics
from dmrl.recording import Contents

NEVER = (topics.CAMERA_IMAGE, topics.LABELS, topics.DETECTIONS, topics.GRID, topics.TRACKS)
"""What a dataset is made of, or what was made of it: no sensors."""


def sensors_of(names: Iterable[str]) -> list[str]:
    """Rows of the table of topics that recordings with these topics have, in its order."""
    names = set(names)
    patterns = (row.pattern for row in topics.TOPICS if row.pattern not in NEVER)
    return [p for p in patterns if any(topics.names(p, name) is not None for name in names)]


def cameras_of(held: Iterable[Contents]) -> dict[str, str]:
    """Words for the first calibration of each robot's camera, by recording and robot."""
    found = {}
    for one in held:
        for topic in one.topics:
            robot = topics.names(topics.CALIBRATION, topic)
            if robot is not None:
                for stamped in islice(one.messages(topic), 1):
                    k, distortion = list(stamped.message.K), list(stamped.message.D)
                    if len(k) != 9:
                        continue
                    size = f"{stamped.message.width} x {stamped.message.height} px"
                    words = f"{size}, fx {k[0]:.2f}, fy {k[4]:.2f}, cx {k[2]:.2f}, cy {k[5]:.2f}"
                    bent = ", ".join(f"{value:.4g}" for value in distortion)
                    name = f"{one.path.name}: {robot['robot']}"
                    found[name] = words + (f", distortion {bent}" if any(distortion) else "")
    return found
