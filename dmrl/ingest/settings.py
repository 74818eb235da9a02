"""Settings of ``dmrl record``. Imports nothing heavy: they are flags."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from cyclopts import Parameter, validators


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Rate and form of the samples, and the length of the recording.

    Parameters
    ----------
    duration_s
        Stop after so many seconds. Without it, at Ctrl-C.
    rate_hz
        Log packets per second and block; the firmware has 10 ms steps.
    pixels
        Whether raw images are behind colour filters: colour, or grey for the grey AI-deck.
    images
        How images are stored that are not JPEG already: png, nothing lost, or jpeg, a fifth
        of that.
    peer
        Robot to which ranging.distance<N> is the distance, as N=NAME; repeat for more. Without
        it, cf<N>.
    """

    duration_s: Annotated[float | None, Parameter(validator=validators.Number(gt=0, lt=1e6))] = None
    rate_hz: Annotated[float, Parameter(validator=validators.Number(gte=1, lte=100))] = 100.0
    pixels: Literal["colour", "grey"] = "colour"
    images: Literal["png", "jpeg"] = "png"
    peer: Annotated[tuple[str, ...], Parameter(negative=())] = field(default=())
