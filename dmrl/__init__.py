"""dmrl: recordings in, recordings out; teach tiny camera drones to see each other.

`dmrl.api` is loaded when one of its names is used, and with each name only what that needs.
"""

from dmrl.guards.telemetry import disable_telemetry

__version__ = "0.3.0"

disable_telemetry()  # dependencies read their switches when they are imported

# Where each public name lives. `__init__.pyi` says the same to type checkers, a test holds them
# together; imports here would be a circle, since every package reads for the version.
_PLACES = {
    "Data": "data",
    "Detection": "models",
    "Images": "images",
    "Model": "models",
    "Recording": "recordings",
    "Result": "results",
    "Rows": "data",
    "Topic": "topic",
    "Writer": "writing",
    "align": "stages",
    "calibrate": "stages",
    "convert": "stages",
    "dataset": "data",
    "evaluate": "stages",
    "fly": "stages",
    "label": "stages",
    "load": "models",
    "make_dataset": "stages",
    "merge": "stages",
    "open": "recordings",
    "predict": "stages",
    "quantize": "stages",
    "render": "stages",
    "sketch": "stages",
    "track": "stages",
    "train": "stages",
    "trim": "stages",
    "writer": "writing",
}
__all__ = ["__version__", *_PLACES]


def __getattr__(name: str) -> object:
    from importlib import import_module  # noqa: PLC0415 - Ctrl-C at the start of a command

    if name in _PLACES:
        return getattr(import_module(f"dmrl.api.{_PLACES[name]}"), name)
    raise AttributeError(f"dmrl has no {name}. It has: {', '.join(sorted(_PLACES))}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
