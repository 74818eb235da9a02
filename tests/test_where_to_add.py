"""The table "Where to add" of docs/architecture.md, each row followed in a copy of the sources.

A test edits the copy as its row says. The number of edited files must equal that of the table.
Each test is named after its row.
"""

import json
import re
import shutil
from pathlib import Path

import pytest

from .clone import ROOT, Clone
from .viewer.rrd import read_panel_names

pytestmark = pytest.mark.heavy

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def read_file_count(row: str) -> int:
    """Return the number of files that the table gives for a row."""
    table = PAGE.split("## Where to add")[1]
    (found,) = re.findall(rf"^\| {row} \|.*\| (\d+) \|$", table, re.MULTILINE)
    return int(found)


@pytest.fixture
def clone(tmp_path: Path) -> Clone:
    """Return a copy of the sources."""
    return Clone(tmp_path / "clone")


def write_flight(folder: Path, columns: dict[str, float]) -> Path:
    """Write a CSV flight of one robot: three rows of the required columns and of these."""
    names = ["time_s", "roll_rad", "pitch_rad", "yaw_rate_radps", "vx_mps", "vy_mps", "height_m"]
    rows = [[*names, *columns], *([k / 10, *[0.0] * 6, *columns.values()] for k in range(3))]
    folder.mkdir()
    text = "\n".join(",".join(map(str, row)) for row in rows)
    (folder / "cf1.csv").write_text(text + "\n", encoding="utf-8")
    return folder


SENSORS = """    Topic(
        "/{robot}/pressure",
        "dmrl.v1.Pressure",
        "-",
        "Pa",
        "50 Hz",
        "convert",
        sensor=True,
        curve=PlotSpec("pressure, Pa", ("pressure_pa",)),
        csv=("pressure_pa",),
    ),
    Topic(
        "/{robot}/range_up",
        "dmrl.v1.RangeUp",
        "world z",
        "m",
        "50 Hz",
        "convert",
        sensor=True,
        curve=PlotSpec("height, m", ("range_up_m",), name="up"),
        csv=("range_up_m",),
    ),
    Topic(
        "/{robot}/sonar/{peer}",
        "dmrl.v1.Sonar",
        "-",
        "m",
        "10 Hz",
        "convert",
        sensor=True,
        curve=PlotSpec("distance, m", ("sonar_m",)),
        csv=("sonar_m",),
    ),
"""


def test_a_sensor(clone: Clone, tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    own = 'syntax = "proto3";\npackage dmrl.v1;\nmessage {} {{\n  double {} = 1;\n}}\n'
    for name, field in (
        ("Pressure", "pressure_pa"),
        ("RangeUp", "range_up_m"),
        ("Sonar", "sonar_m"),
    ):
        clone.write(f"schemas/dmrl/v1/{name.lower()}.proto", own.format(name, field))
    clone.insert_after("dmrl/topics.py", "TOPICS = (\n", SENSORS)
    # The table of topics is counted; each of the three sensors also adds a schema.
    assert clone.count_edited_files() == 3 + read_file_count("a sensor")
    clone.run_python(str(clone.root / "schemas" / "build.py"))

    values = {"pressure_pa": 101_325.0, "range_up_m": 1.5, "sonar_cf2_m": 2.5}
    source = write_flight(tmp_path / "flight", values)
    out, again, short = (tmp_path / f"{name}.mcap" for name in ("out", "again", "short"))
    shown, alone = tmp_path / "shown.rrd", tmp_path / "alone.rrd"
    converted, info, _, merged, *_ = clone.run_dmrl(
        ["convert", source, out],
        ["info", out, "--json"],
        ["trim", out, short, "--topic", "/cf1/pressure"],
        ["merge", short, out, again],
        ["view", out, "--save", shown],
        ["view", short, "--save", alone],
    )
    assert "ranges to up" not in converted
    held = json.loads(info)["topics"]
    assert held["/cf1/pressure"]["message"] == "dmrl.v1.Pressure"
    assert held["/cf1/pressure"]["count"] == 3
    assert held["/cf1/range_up"]["count"] == held["/cf1/sonar/cf2"]["count"] == 3
    assert "/cf1/range/up" not in held
    assert "both have /cf1/pressure" in merged
    assert {"pressure, Pa", "height, m", "distance of cf2, m"} <= read_panel_names(shown)
    assert "pressure, Pa" in read_panel_names(alone)  # in a recording of this sensor alone
    shutil.copytree(ROOT / "docs", clone.root / "docs")
    place = str(clone.root / "docs")
    code = f"import sys; sys.path.insert(0, {place!r}); import build; print(build.topics())"
    row = "| `/<robot>/sonar/<peer>` | `dmrl.v1.Sonar` | - | m | 10 Hz |"
    assert row in clone.run_python("-c", code)


FORMAT = '''
    """Texts of heights: a time in nanoseconds and metres on each line."""

    from pathlib import Path

    from dmrl import topics
    from dmrl.formats.base import Content, Format, Options
    from dmrl.samples.sample import Sample


    def recognises(source: Path) -> bool:
        """Whether it is called so."""
        return source.suffix == ".alt"


    def content(source: Path, options: Options) -> Content:
        """A sample a line."""
        rows = [line.split() for line in source.read_text().splitlines()]
        topic = topics.HEIGHT(options.robot)
        return Content(Sample(int(t), topic, "Height", {"height_m": float(z)}) for t, z in rows)


    FORMAT = Format("altitudes", "a text of heights", recognises, content)
'''


def test_a_foreign_format(clone: Clone, tmp_path: Path) -> None:
    clone.write("dmrl/formats/altitudes.py", FORMAT)
    assert clone.count_edited_files() == read_file_count("a foreign format")
    source, out = tmp_path / "flight.alt", tmp_path / "out.mcap"
    source.write_text("1000 0.5\n2000 0.75\n")
    (output,) = clone.run_dmrl(["convert", source, out])
    assert "/cf1/height" in output


NETWORK = """
class Tiny(Network):
    \"\"\"Three strided convolutions.\"\"\"

    def __init__(self, extra: Sequence[str] = ()) -> None:
        super().__init__(extra)
        self.body = nn.Sequential(*(ConvNorm(k, 8, stride=2) for k in (3, 8, 8)))
        self.head = nn.Conv2d(8, len(self.channels), 1)

    def forward(self, images: Tensor) -> Tensor:
        \"\"\"(N, C, H/8, W/8).\"\"\"
        out: Tensor = self.head(self.body(images))
        return out

"""


def test_a_network(clone: Clone, tmp_path: Path) -> None:
    name = "dmrl/learn/networks/architectures.py"
    clone.insert_after(
        name, "    widths: ClassVar[tuple[int, int, int]] = (24, 64, 96)\n", "\n" + NETWORK
    )
    clone.insert_after(name, "ARCHITECTURES: dict[str, type[Network]] = {\n", '    "tiny": Tiny,\n')
    assert clone.count_edited_files() == read_file_count("a network")
    made, out = tmp_path / "tiny", tmp_path / "export"
    made.mkdir()
    output = clone.run_python(
        "-c",
        "import sys\n"
        "from pathlib import Path\n"
        "from dmrl.cli import main\n"
        "from dmrl.learn.inference.loaded_model import Model, save_model\n"
        "from dmrl.learn.networks.architectures import build_network\n"
        f"save_model(Model(build_network('tiny').eval(), 'tiny'), Path({str(made)!r}))\n"
        f"sys.argv = ['dmrl', 'export', {str(made)!r}, {str(out)!r}]\n"
        "main()\n",
    )
    assert "model.onnx" in output


LOSS = """

def _certain(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    return out["confidence"].sigmoid().mean()

"""


def test_a_loss(clone: Clone) -> None:
    name = "dmrl/learn/training/losses.py"
    clone.insert_after(
        name, "    classes: tuple[str, ...] = ()\n", "    certain_weight: float = 0.0\n"
    )
    clone.insert_after(name, "return class_loss(logits, wanted.class_id, wanted.weight)\n", LOSS)
    term = '    LossTerm("certain_loss", "certain_weight", ("confidence",), _certain),\n'
    clone.insert_after(name, "TERMS = (\n", term)
    assert clone.count_edited_files() == read_file_count("a loss")
    output = clone.run_python(
        "-c",
        "import torch\n"
        "from dmrl.learn.data.batches import Batch\n"
        "from dmrl.learn.networks.architectures import build_network\n"
        "from dmrl.learn.training.config import TrainConfig\n"
        "from dmrl.learn.training.train_step import LOSS_NAMES, compute_losses\n"
        "images = torch.zeros(1, 3, 32, 40, dtype=torch.uint8)\n"
        "batch = Batch(images, torch.full((1, 1, 11), torch.nan))\n"
        "network = build_network('locanet').eval()\n"
        "for weight in (0.0, 3.0):\n"
        "    parts = compute_losses(network, batch, TrainConfig(certain_weight=weight))\n"
        "    print(float(parts.detach()[LOSS_NAMES.index('certain_loss')]) > 0)\n",
    )
    assert output.split() == ["False", "True"]


COMMAND = '''
    """hello: greet."""

    from dataclasses import dataclass

    from dmrl.pipeline.stage_command import stage_command
    from dmrl.terminal.closing import Closing


    @dataclass(frozen=True, slots=True)
    class Settings:
        """Manners.

        Parameters
        ----------
        loud
            Shout.
        """

        loud: bool = False


    def run(name: str, settings: Settings) -> dict[str, int]:
        """Greet somebody.

        Parameters
        ----------
        name
            Whom to greet.
        """
        return {f"hello {name}".upper() if settings.loud else f"hello {name}": 1}


    command = stage_command(
        run,
        Closing(lines=lambda greetings, _: list(greetings), document=lambda greetings, _:
        greetings),
    )
'''


def test_a_command(clone: Clone) -> None:
    clone.write("dmrl/stages/hello.py", COMMAND)
    clone.insert_after("dmrl/cli.py", "GROUPS = {\n", '    "Greet": ("hello",),\n')
    assert clone.count_edited_files() == read_file_count("a command")
    greeted, shouted, told, helped, listed = clone.run_dmrl(
        ["hello", "cf1"],
        ["hello", "cf1", "--loud"],
        ["hello", "cf1", "--json"],
        ["hello", "--help"],
        ["--help"],
    )
    assert (greeted, shouted) == ("hello cf1\n", "HELLO CF1\n")
    assert json.loads(told) == {"hello cf1": 1}
    assert "Whom to greet." in helped and "Shout." in helped
    assert "Greet somebody." in listed


VIEW = '''
    """Layout ``heights``: how high every robot flies, and nothing else."""

    from functools import partial

    from dmrl import topics
    from dmrl.viewer import layouts
    from dmrl.viewer.drawing import time_plots
    from dmrl.viewer.scene import DrawRule, Scene
    from dmrl.viewer.selection import Selection
    from dmrl.viewer.settings import Settings


    def scene(selection: Selection, settings: Settings) -> Scene:
        """One panel."""
        row = topics.find_topic("/any/height")
        robots = [found["robot"] for found in selection.find_names(topics.HEIGHT)]
        draws = [
            DrawRule(path, partial(time_plots.draw_sensor, path, row=row, robot=robot, own=True))
            for robot in robots
            for path in [topics.HEIGHT(robot)]
        ]
        panel = layouts.PlotPanel("heights alone, m", tuple(draw.topic for draw in draws))
        return Scene(layouts.build_window(layouts.build_plot_view(panel)), draws, [], [])
'''


def test_a_view(clone: Clone, tmp_path: Path) -> None:
    clone.write("viewer/views/heights.py", VIEW)
    assert clone.count_edited_files() == read_file_count("a view")
    out, shown = tmp_path / "out.mcap", tmp_path / "shown.rrd"
    *_, explained = clone.run_dmrl(
        ["convert", write_flight(tmp_path / "flight", {}), out],
        ["view", out, "--layout", "heights", "--save", shown],
        ["view", "--help"],
    )
    assert read_panel_names(shown) == {"heights alone, m"}
    assert "heights" in explained


def test_every_row_of_the_table_is_tried() -> None:
    table = PAGE.split("## Where to add")[1].split("\n\n")
    rows = [
        line.split(" | ")[0].strip("| ")
        for part in table
        for line in part.splitlines()
        if line.startswith("| a")
    ]
    tests = {name.removeprefix("test_").replace("_", " ") for name in globals()}
    assert rows and [row for row in rows if row not in tests] == []
