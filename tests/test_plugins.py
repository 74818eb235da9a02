"""Plug-ins installed as entry points work, load lazily, and fail safely."""

import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from dmrl import entry_points, plugins
from dmrl.api.writing import writer
from dmrl.errors import PluginError, SettingError, SourceError
from dmrl.formats.registry import find_format
from dmrl.learn.inference.loaded_model import Model, load_model, save_model
from dmrl.learn.networks.architectures import build_network, list_architectures
from dmrl.recording import read_summary, read_table
from dmrl.stages import convert, fly

Install = Callable[..., None]
EXTEND = Path(__file__).parents[1] / "docs" / "extend.md"

FORMAT = """
    from dmrl import topics
    from dmrl.plugins import Content, Format, Sample

    def recognises(source):
        return source.suffix == ".alt"

    def content(source, options):
        rows = [line.split() for line in source.read_text().splitlines()]
        topic = topics.HEIGHT(options.robot)
        return Content(
            Sample(int(time_ns), topic, "Height", {"height_m": float(high)})
            for time_ns, high in rows
        )

    FORMAT = Format("whatever", "a text of heights", recognises, content)
"""
NETWORK = """
    import torch
    from torch import nn
    from dmrl.plugins import ConvNorm, Network

    class Tiny(Network):
        def __init__(self, extra=()):
            super().__init__(extra)
            self.body = nn.Sequential(
                ConvNorm(3, 8, stride=2), ConvNorm(8, 8, stride=2), ConvNorm(8, 8, stride=2)
            )
            self.head = nn.Conv2d(8, len(self.channels), 1)

        def forward(self, images):
            return self.head(self.body(images))
"""
PILOT = """
    from dmrl.plugins import Command, Pilot

    class Wild(Pilot):
        def command(self, seen):
            return {}["peer"]
"""
STAGE = """
    from pathlib import Path

    def command(word: str, /, *, times: int = 1) -> None:
        \"\"\"Say a word.

        Parameters
        ----------
        word
            What to say.
        times
            How often.
        \"\"\"
        if word == "end":
            raise SystemExit(7)
        if word == "fall":
            raise ValueError("over\\nthe edge")
        print(word * times)
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Return a function that installs a package of one module with entry points."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=os.pathsep)

    def install_package(package: str, text: str, **entries: str) -> None:
        module = package.replace("-", "_")
        (site / f"{module}.py").write_text(textwrap.dedent(text))
        about = site / f"{module}-1.0.dist-info"
        about.mkdir()
        about.joinpath("METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\nSummary: Made by others.\n"
        )
        about.joinpath("entry_points.txt").write_text(
            "".join(f"[dmrl.{group}]\n{line}\n" for group, line in entries.items())
        )
        entry_points.find_plugins.cache_clear()

    yield install_package
    entry_points.find_plugins.cache_clear()
    for path in site.glob("*.py"):
        sys.modules.pop(path.stem, None)


def run_dmrl(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    command = [sys.executable, "-m", "dmrl.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


@pytest.mark.parametrize("kind", ["altitudes", None])
def test_a_format_of_another_package_is_converted_from(
    kind: str | None, install: Install, tmp_path: Path
) -> None:
    install("alt-logs", FORMAT, formats="altitudes = alt_logs:FORMAT")
    source, out = tmp_path / "flight.alt", tmp_path / "out.mcap"
    source.write_text("1000 0.5\n2000 0.75\n")
    convert.run(source, out, convert.Settings(source_kind=kind))
    assert read_table(out, "/cf1/height")["height_m"].to_pylist() == [0.5, 0.75]
    assert read_summary(out).topics["/cf1/height"].schema == "dmrl.v1.Height"


def test_plugin_names_are_listed_without_import(install: Install, tmp_path: Path) -> None:
    install("alt-logs", "raise AssertionError('imported')", formats="altitudes = alt_logs:FORMAT")
    (tmp_path / "flight.bin").write_bytes(b"\0\1")
    with pytest.raises(SourceError, match=r"Did you mean altitudes.* Formats: .*images, altitudes"):
        find_format(tmp_path / "flight.bin", "altitude")
    assert "alt_logs" not in sys.modules


def test_plugins_cannot_override_built_in_names(install: Install, tmp_path: Path) -> None:
    install(
        "alt-logs", FORMAT, formats="csv = alt_logs:FORMAT", networks="locanet = alt_logs:FORMAT"
    )
    (tmp_path / "flight.alt").touch()
    assert find_format(tmp_path, "csv").what == "a folder of flight logs"
    assert type(build_network("locanet")).__name__ == "LocaNet"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import nothing_like_it", "cannot be loaded: ModuleNotFoundError: No module named"),
        ("FORMAT = 1", "is not a dmrl.plugins.Format: alt_logs:FORMAT"),
        (
            FORMAT.replace("source.suffix", "source.missing"),
            "fails to check .*flight.alt: AttributeError",
        ),
        ("raise SystemExit(3)", "cannot be loaded: RuntimeError: it ends the program, with 3"),
    ],
)
def test_broken_format_plugin_is_reported_and_skipped(
    text: str, said: str, install: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install("alt-logs", text, formats="altitudes = alt_logs:FORMAT")
    source = tmp_path / "flight.alt"
    source.write_text("1 1\n")
    with pytest.raises(PluginError, match=f"of the package alt-logs, {said}.*uninstall alt-logs"):
        form = find_format(source, "altitudes")
        form.recognises(source)
    with pytest.raises(SourceError, match="matches no known format"):
        find_format(source)
    (line,) = capsys.readouterr().err.splitlines()
    assert "of the package alt-logs" in line


@pytest.mark.heavy
def test_a_format_that_fails_while_it_reads_leaves_nothing(
    install: Install, tmp_path: Path
) -> None:
    install("alt-logs", FORMAT, formats="altitudes = alt_logs:FORMAT")
    source, out = tmp_path / "flight.alt", tmp_path / "out.mcap"
    source.write_text("1000 0.5\n2000 high\n")
    done = run_dmrl("convert", str(source), str(out))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "of the package alt-logs, fails to read" in done.stderr
    assert "ValueError: could not convert string to float: 'high'" in done.stderr
    assert not out.exists()


def test_a_network_of_another_package_is_built_saved_and_loaded(
    install: Install, tmp_path: Path
) -> None:
    install("tiny-nets", NETWORK, networks="tiny = tiny_nets:Tiny")
    assert "tiny" in list_architectures()
    network = build_network("tiny", seed=3)
    (tmp_path / "model").mkdir()
    save_model(Model(network.eval(), "tiny"), tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    images = np.zeros((1, 16, 24, 3), np.uint8)
    assert loaded.grids(images).confidence.shape == (1, 2, 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 / 0", "cannot be loaded: ZeroDivisionError"),
        ("Tiny = dict", "is not a subclass of dmrl.plugins.Network"),
        (NETWORK.replace("ConvNorm(3", "ConvNrm(3"), "cannot be built: NameError"),
    ],
)
def test_a_broken_network_is_one_line_and_others_are_built(
    text: str, said: str, install: Install
) -> None:
    install("tiny-nets", text, networks="tiny = tiny_nets:Tiny")
    with pytest.raises(PluginError, match=f"of the package tiny-nets, {said}"):
        build_network("tiny")
    assert build_network("locanet")
    with pytest.raises(SettingError, match=r"no architecture tin. Choose one of: .*tiny"):
        build_network("tin")


@pytest.mark.heavy
@pytest.mark.parametrize("entry", ["say-it = stages_of_mine", "say-it = stages_of_mine:command"])
def test_a_stage_of_another_package_is_a_command(entry: str, install: Install) -> None:
    install("stages-of-mine", STAGE, stages=entry)
    done = run_dmrl("say-it", "word", "--times", "2")
    assert (done.returncode, done.stdout, done.stderr) == (0, "wordword\n", "")
    assert "How often." in run_dmrl("say-it", "--help").stdout
    assert run_dmrl("say-it", "end").returncode == 7
    failed = run_dmrl("say-it", "fall")
    assert failed.returncode == 1
    assert "of the package stages-of-mine, failed: ValueError: over the edge" in failed.stderr
    assert failed.stderr.count("\n") == 1


DECLARED = """
    from dataclasses import dataclass
    from pathlib import Path
    from dmrl.plugins import Closing, stage_command

    @dataclass(frozen=True)
    class Settings:
        \"\"\"How.\"\"\"

        times: int = 1

    def run(recording: Path, out: Path, settings: Settings) -> dict[str, int]:
        \"\"\"Copy a name.

        Parameters
        ----------
        recording
            What to copy.
        out
            Where to.
        \"\"\"
        out.write_text(recording.name * settings.times)
        return {"names": settings.times}

    command = stage_command(
        run,
        Closing(columns=("what", "count"), path_key="recording"),
        name="say-it",
        folder="recording",
    )
"""


@pytest.mark.heavy
def test_a_stage_of_another_package_is_built_from_its_run(install: Install, tmp_path: Path) -> None:
    install("stages-of-mine", DECLARED, stages="say-it = stages_of_mine")
    out = tmp_path / "out.txt"
    done = run_dmrl("say-it", "a.mcap", str(out), "--times", "2", "--json")
    assert json.loads(done.stdout) == {"recording": str(out), "names": 2}
    assert out.read_text() == "a.mcapa.mcap"
    helped = run_dmrl("say-it", "--help").stdout
    assert "What to copy." in helped and "--workers" in helped


@pytest.fixture
def heights(install: Install, tmp_path: Path) -> Path:
    """Install the command `smooth` of docs/extend.md; return a folder with one recording."""
    page = EXTEND.read_text(encoding="utf-8")
    install("smooth", page.split("```python\n")[1].split("```")[0], stages="smooth = smooth")
    (tmp_path / "in").mkdir()
    with writer(tmp_path / "in" / "a.mcap") as out:
        out.write_columns("/cf1/height", [5.0, 6.0, 7.0], {"height_m": [1.0, 3.0, 8.0]})
    return tmp_path / "in"


@pytest.mark.heavy
def test_documented_command_runs_over_a_folder_and_resumes(heights: Path, tmp_path: Path) -> None:
    assert "was there" not in run_dmrl("smooth", "in", "out", "--window", "2", cwd=tmp_path).stdout
    table = read_table(tmp_path / "out" / "a.mcap", "/cf1/height")
    assert table["height_m"].to_pylist() == [1.0, 2.0, 5.5]
    assert table["log_time"].to_pylist() == [5 * 10**9, 6 * 10**9, 7 * 10**9]
    assert "was there" in run_dmrl("smooth", "in", "out", "--window", "2", cwd=tmp_path).stdout
    done = run_dmrl("smooth", "in", "out", "--window", "3", cwd=tmp_path)
    assert done.returncode == 1 and "names other inputs or settings" in done.stderr
    helped = run_dmrl("smooth", "--help").stdout
    assert "Smooth the heights of a recording." in helped and "Made by others" not in helped
    assert "Made by others" in run_dmrl("--help").stdout


@pytest.mark.heavy
def test_settings_of_a_command_are_keys_of_a_step(heights: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.toml"
    step = '[[step]]\nstage = "smooth"\nout = "b.mcap"\nrecording = "{data}/a.mcap"\n'
    recipe.write_text(f'kind = "pipeline"\n{step}window = 2\n')
    done = run_dmrl("run", str(recipe), "--data", "in", "--out", "made", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = read_table(tmp_path / "made" / "b.mcap", "/cf1/height")
    assert table["height_m"].to_pylist() == [1.0, 2.0, 5.5]


def test_arguments_that_a_folder_form_would_lose_are_refused() -> None:
    def run(recording: Path, out: Path, *, window: int = 3) -> None:
        """Do nothing."""

    with pytest.raises(TypeError, match=r"run\(\) takes window, .* dataclass"):
        plugins.stage_command(run, plugins.Closing(), folder="recording")
    assert callable(plugins.stage_command(run, plugins.Closing()))


@pytest.mark.heavy
def test_a_broken_stage_is_listed_and_is_one_line_when_called(install: Install) -> None:
    install("stages-of-mine", "import nothing_like_it", stages="say-it = stages_of_mine")
    helped = run_dmrl("--help")
    assert helped.returncode == 0
    assert "say-it" in helped.stdout
    assert "stages-of-mine" in helped.stdout
    assert helped.stderr == ""
    for words in (["say-it", "x"], ["say-it", "--help"]):
        done = run_dmrl(*words)
        assert done.returncode == 1
        assert "of the package stages-of-mine, cannot be loaded: ModuleNotFoundError" in done.stderr
        assert done.stderr.count("\n") == 1
    assert run_dmrl("info", "--help").returncode == 0


@pytest.mark.heavy
def test_an_error_of_a_pilot_names_its_package(install: Install, tmp_path: Path) -> None:
    install("wild", PILOT, pilots="wild = wild:Wild")
    with pytest.raises(PluginError, match=r"package wild, failed: KeyError: 'peer' \(wild.py:6\)"):
        fly.run(tmp_path / "out.mcap", fly.Settings(pilot="wild", duration_s=1.0))
