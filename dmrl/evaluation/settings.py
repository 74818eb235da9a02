"""Settings of ``dmrl evaluate``."""

from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter, validators

from dmrl.terminal.arguments import Count, Positive, Share

Finite = Annotated[float | None, Parameter(validator=validators.Number(gte=0, lt=1e6))]


@dataclass(frozen=True, slots=True)
class Settings:
    """Kind of results, labels, images and threshold of an evaluation.

    Parameters
    ----------
    what
        "auto": flight where a pilot flew a robot, tracks where there are any with true positions,
        else detections, else estimated positions. flight: seconds held, contacts, silent stretches
        and alarms over time.
    against
        Whose labels.
    split
        Only images of this split of the recording's source, such as test. Without it, all.
    partial
        Judge only images that have a Detections message. Without it, one without counts as an
        image in which nothing was found.
    threshold
        Confidence from which a detection counts in precision, recall and F1, 0 to 1. Without
        it, the one in the recording.
    false_alarms
        Choose the threshold on these images: that of the best F1 among those at which an image
        without a robot has at most so many detections, on average, such as 0.05.
    robot_width_m
        Width of the robots, metres, such as 0.13 for a Crazyflie with its propellers: detections
        are also judged as boxes so wide, by COCO's average precision. Needs dmrl[coco].
    draws
        Bootstrap samples behind the 95 % intervals.
    seed
        Of the bootstrap.
    settle_s
        positions, tracks: errors in the first seconds do not count, except for kept positions.
        Without it, 20 s, or half of a flight under 30 s.
    """

    what: Literal["auto", "detections", "flight", "positions", "tracks"] = "auto"
    against: Literal["truth", "estimate", "hand", "published"] = "truth"
    split: str | None = None
    partial: Annotated[bool, Parameter(negative=())] = False
    threshold: Share | None = None
    false_alarms: Finite = None
    robot_width_m: Positive | None = None
    draws: Count = 1000
    seed: int = 0
    settle_s: Finite = None
