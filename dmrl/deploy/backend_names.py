"""Names of the backends. Imports nothing heavy: help shows them."""

from typing import Literal

BackendName = Literal["torch", "onnx", "onnx-int8", "integer", "c", "riscv32"]
