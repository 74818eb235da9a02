"""Write how to use an export: README.md, with programs for onnxruntime, ROS 2, C and C++."""

import json
from pathlib import Path

from dmrl.deploy.c.templating import fill_template
from dmrl.deploy.detector import FLOAT_ONNX_NAME, INT8_ONNX_NAME
from dmrl.learn.pretrained import DESCRIPTION_NAME

README_NAME = "README.md"


def write_usage(folder: Path) -> None:
    """Write the programs into README.md of an export folder, below its text."""
    described = json.loads((folder / DESCRIPTION_NAME).read_text(encoding="utf-8"))
    onnx = INT8_ONNX_NAME if (folder / INT8_ONNX_NAME).is_file() else FLOAT_ONNX_NAME
    text = fill_template("usage_onnx.md", **described, onnx=onnx)
    for path in sorted(folder.glob("*.h")):
        name, header = path.stem, path.read_text(encoding="utf-8")
        if f"{name}_run(" in header:
            text += fill_template("usage_c.md", **described, c=name, far=f"{name}_far_t" in header)
    readme = folder / README_NAME
    before = readme.read_text(encoding="utf-8") + "\n" if readme.is_file() else ""
    readme.write_text(before + text, encoding="utf-8")
