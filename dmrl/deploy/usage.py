"""Write how to use an export: README.md, with programs for onnxruntime, ROS 2, C and C++."""

import json
from importlib.resources import files
from pathlib import Path
from string import Template

from dmrl.deploy.detector import FLOAT_ONNX_NAME, INT8_ONNX_NAME
from dmrl.learn.pretrained import DESCRIPTION_NAME

README_NAME = "README.md"
OFFSETS = {"offset_u": "col", "offset_v": "row"}


def write_usage(folder: Path) -> None:
    """Write the programs into README.md of an export folder, below its text."""
    described = json.loads((folder / DESCRIPTION_NAME).read_text(encoding="utf-8"))
    stride = described["stride_px"]
    headers = sorted(path.stem for path in folder.glob("*.h") if _is_network(path))
    grey = described["channels"] == 1
    values = {
        "name": described["architecture"],
        "onnx": INT8_ONNX_NAME if (folder / INT8_ONNX_NAME).is_file() else FLOAT_ONNX_NAME,
        "height": described["height_px"],
        "width": described["width_px"],
        "channels": described["channels"],
        "format": "grey" if grey else "red, green, blue",
        "mode": "L" if grey else "RGB",
        "stride": stride,
        "rows": described["height_px"] // stride,
        "cols": described["width_px"] // stride,
        "threshold": f"{described['threshold']:.3g}",
        "offset_rows": "".join(
            f"| `{name}` | pixels: `{stride} * ({place} + 0.5 + x)` |\n"
            for name, place in OFFSETS.items()
            if name in described["outputs"]
        ),
    }
    for name in OFFSETS:
        there = name in described["outputs"]
        values[name] = f' + out["{name}"][row, col]' if there else ""
    text = _fill("onnx.md", values)
    for header in headers:
        far = f"static {header}_far_t away;\n" if _has_far_memory(folder / f"{header}.h") else ""
        state = "&net, &away" if far else "&net"
        text += _fill(
            "c.md", {**values, "c": header, "C": header.upper(), "far": far, "state": state}
        )
    readme = folder / README_NAME
    before = readme.read_text(encoding="utf-8") + "\n" if readme.is_file() else ""
    readme.write_text(before + text, encoding="utf-8")


def _is_network(header: Path) -> bool:
    return f"{header.stem}_run(" in header.read_text(encoding="utf-8")


def _has_far_memory(header: Path) -> bool:
    return f"{header.stem}_far_t" in header.read_text(encoding="utf-8")


def _fill(page: str, values: dict[str, object]) -> str:
    text = files("dmrl.deploy").joinpath("usage_pages", page).read_text(encoding="utf-8")
    return Template(text).substitute(values)
