"""Hostile recipes and other untrusted TOML, to every command that reads TOML."""

from dataclasses import fields
from math import isfinite
from typing import Any

import numpy as np
import pytest

from dmrl import recipe
from dmrl.images.codec import encode_png
from dmrl.stages import fly, render, train

from .box import Box, run_and_capture, write_hostile_recording

COMMANDS = {
    "run": ("run", "TOML", "--out", "OUT/run"),
    "render": ("render", "TOML", "OUT/a.mcap"),
    "fly": ("fly", "TOML", "OUT/a.mcap"),
    "train": ("train", "IN/set", "OUT/run", "--recipe", "TOML"),
    "label, sensors": ("label", "IN/a.mcap", "OUT/a.mcap", "--sensors", "TOML"),
    "track": ("track", "IN/a.mcap", "OUT/a.mcap", "--camera.cf1", "TOML"),
    "calibrate": ("calibrate", "IN/a.mcap", "OUT/a.toml", "--camera", "TOML"),
    "convert, columns": ("convert", "IN/logs", "OUT/a.mcap", "--columns", "TOML"),
    "convert, a camera": ("convert", "IN/pictures", "OUT/a.mcap", "--camera", "TOML"),
}
"""Every way in which a command reads TOML."""

TEXTS = {
    "lists in lists": "a = " + "[" * 10_000 + "]" * 10_000,
    "tables in tables": "a = " + "{a = " * 10_000 + "1" + "}" * 10_000,
    "dotted keys": "a" + ".a" * 10_000 + " = 1",
    "10 MB of text": 'a = "' + "x" * 10_000_000 + '"',
    "a number of 100,000 digits": "a = 1" + "0" * 99_000,
    "a number of 65 bits": f"a = {2**64}",
    "NaN": "a = nan",
    "no key that is known": '"\\u001b[2J\\n../../victim/keep" = -inf',
    "9,000 keys": "\n".join(f"a{k} = 1" for k in range(9_000)),
    "no UTF-8": "a = '\udcff'",
    "NUL": "a = '\0'",
    "half a line": "kind = ",
    "nothing": "",
}


@pytest.fixture
def box_with_inputs(box: Box) -> Box:
    """Return the box with the other inputs that the commands need."""
    write_hostile_recording(box.root / "in" / "a.mcap", robots=("cf1",))
    for name in ("logs", "pictures"):
        (box.root / "in" / name).mkdir()
    (box.root / "in" / "logs" / "cf1.csv").write_text("t,h\n0,1\n1,2\n")
    picture = encode_png(np.zeros((48, 64, 3), np.uint8))
    (box.root / "in" / "pictures" / "a.png").write_bytes(picture)
    return box


@pytest.mark.parametrize(
    "command",
    ["run", *(pytest.param(c, marks=pytest.mark.heavy) for c in list(COMMANDS)[1:])],
)
@pytest.mark.heavy
def test_hostile_toml_gives_one_line_error_that_names_it(
    command: str, box_with_inputs: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    path = box_with_inputs.root / "in" / "strange.toml"
    places = {
        "TOML": str(path),
        "IN": str(box_with_inputs.root / "in"),
        "OUT": str(box_with_inputs.out),
    }
    words = [
        places.get(first := w.split("/")[0], first) + w[len(first) :] for w in COMMANDS[command]
    ]
    for name, text in TEXTS.items():
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        status, output = run_and_capture(box_with_inputs, capsys, *words)
        assert (status, output.count("\n")) == (1, 1), (name, output)
        assert "strange.toml" in output and len(output) < 600, (name, output)
        assert list(box_with_inputs.out.iterdir()) == [], name


VALUES: tuple[Any, ...] = (
    *(2**63, -(2**63), 1e308, float("nan"), float("inf"), -float("inf"), True),
    *("../../x", "/dev/zero", "a\0b\x1b[2J\n", "x" * 50_000, [], {}, [1] * 10_000, {"a": [{}]}),
)


@pytest.mark.parametrize("kind", ["render", "fly", "train"])
@pytest.mark.heavy
def test_every_setting_is_right_or_refused_in_one_line(
    kind: str,
) -> None:
    """Values of any type and size are tried; numbers that are not finite are always refused."""
    settings = {"render": render, "fly": fly, "train": train}[kind].Settings
    for field in fields(settings):
        for value in VALUES:
            keys = {field.name: value}
            wrong = recipe.find_faults(render.filled(keys) if kind == "render" else keys, settings)
            assert "\n" not in str(recipe.recipe_error("a.toml", wrong))
            if isinstance(value, float) and not isfinite(value):
                assert wrong, (field.name, value)
