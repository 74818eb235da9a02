"""Switch off the telemetry of every dependency.

The switches are environment variables, which the packages read once, when they are imported or
start their first session. `dmrl` sets them when it is imported itself, before it imports anything
heavy; processes that it starts inherit them.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

OPT_OUT = {
    # onnxruntime 1.29 and later: an identifier in the temporary folder, uploads to Microsoft.
    "ORT_DISABLE_TELEMETRY": "1",
    "ORT_TELEMETRY_DISABLED": "1",  # the name in its releases before
    "RAY_USAGE_STATS_ENABLED": "0",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "DO_NOT_TRACK": "1",  # the common name, which several tools honour
}


def disable_telemetry() -> None:
    """Set the opt-out variable of every dependency, overriding the environment."""
    os.environ.update(OPT_OUT)


@contextmanager
def hide_module(name: str) -> Iterator[None]:
    """Make an optional package look absent to modules that are imported in the block."""
    if name in sys.modules:
        yield
        return
    sys.modules[name] = None  # type: ignore[assignment] # as the import system documents it
    try:
        yield
    finally:
        del sys.modules[name]
