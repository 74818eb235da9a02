"""Stand-ins for the packages that a command works with, while only its help is wanted.

The help of a command is made of its function's names, types and words. Loading PyTorch for that
takes seconds, so here modules of `PACKAGES` are empty, and whatever is taken from them is
`Anything`. Nothing may be run after this: the process prints a page and ends.
"""

import math
import sys
from abc import ABCMeta
from collections.abc import Iterator, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

PACKAGES = frozenset(
    {
        *(
            "PIL",
            "bpy",
            "cflib",
            "cv2",
            "duckdb",
            "filterpy",
            "google",
            "h5py",
            "lz4",
            "matplotlib",
            "mcap",
        ),
        *(
            "numpy",
            "onnx",
            "onnxruntime",
            "packaging",
            "pandas",
            "pyarrow",
            "pydantic",
            "ray",
            "rerun",
        ),
        *("rerun_cli", "rosbags", "safetensors", "scipy", "tensorboard", "tomli_w", "torch"),
        *("zstandard",),
    }
)
NUMBERS = {"pi": math.pi, "inf": math.inf, "nan": math.nan}
"""Of NumPy: settings have them as defaults."""
BINARY = ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul", "and", "or", "xor")
REFLECTED = tuple(f"r{name}" for name in BINARY)
OTHERS = ("lt", "le", "gt", "ge", "neg", "pos", "invert", "getitem", "enter")


class _Kind(ABCMeta):
    """What can be called, indexed, reckoned with and derived from, and is itself again."""

    def __call__(cls, *_given: Any, **_named: Any) -> Any:
        return cls

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return cls

    def __iter__(cls) -> Iterator[Any]:
        return iter(())

    def __len__(cls) -> int:
        return 0

    def __int__(cls) -> int:
        return 0

    def __float__(cls) -> float:
        return 0.0


for _name in (*BINARY, *REFLECTED, *OTHERS):
    setattr(_Kind, f"__{_name}__", lambda cls, *_given: cls)


class Anything(metaclass=_Kind):
    """What a stand-in holds."""


class _StandIn(ModuleType):
    __path__: list[str] = []  # noqa: RUF012  so that what lies below is looked for

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return NUMBERS.get(name, Anything)


class _Finder(MetaPathFinder, Loader):
    def find_spec(self, name: str, path: Sequence[str] | None, target: Any = None) -> Any:
        if name.partition(".")[0] in PACKAGES and name not in sys.modules:
            return ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _StandIn(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: it stays empty."""


def install() -> None:
    """Let every import of `PACKAGES` from now on give a stand-in."""
    sys.meta_path.insert(0, _Finder())
