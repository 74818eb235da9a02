"""mypy --strict accepts a correct program that uses dmrl, and finds errors in a wrong one."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CLIENT = """
from pathlib import Path

import dmrl


def learn(path: Path) -> float:
    rec = dmrl.open(path)
    names: list[str] = list(rec.topics)
    for image in rec.images("cf1").between(0.0, 2.0):
        height, width, _ = image.shape
    table = rec[names[0]].to_arrow()
    train = dmrl.dataset("dataset")["train"]
    for batch in train.loader(batch_size=8, shuffle=True, seed=1):
        print(batch["image"].shape)
    found: list[list[dmrl.Detection]] = dmrl.load("model").detect(rec.images("cf1"))
    dmrl.label(path, "labelled.mcap")
    judged: dmrl.Result = dmrl.evaluate(path)
    print(judged["overall"]["median_px"]["value"], train[:3]["depth"].mean())
    with dmrl.writer("found.mcap", network="mine") as out:
        out.write("/cf1/detections", 0.5, {"detections": [], "threshold": 0.5})
    return found[0][0].depth_m + float(table.num_rows)
"""


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Link the sources as they are installed, with viewer/, schemas/ and recipes/ in dmrl/."""
    folder = tmp_path_factory.mktemp("layout")
    (folder / "dmrl").mkdir()
    for part in [*(ROOT / "dmrl").iterdir(), *(ROOT / n for n in ("viewer", "schemas", "recipes"))]:
        (folder / "dmrl" / part.name).symlink_to(part)
    return folder


def check_types(layout: Path, program: str) -> tuple[int, str]:
    """Check a program with mypy; return the exit status and the output."""
    (layout / "client.py").write_text(program)
    # Use dmrl's own configuration: strict, but without errors of untyped packages.
    words = ["--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(layout / "cache")]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words, "client.py"],
        cwd=layout,
        capture_output=True,
        text=True,
        timeout=1500,
    )
    return done.returncode, done.stdout


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_mypy_accepts_a_correct_client_and_finds_a_wrong_attribute(layout: Path) -> None:
    assert check_types(layout, CLIENT) == (0, "Success: no issues found in 1 source file\n")
    wrong = CLIENT.replace("found[0][0].depth_m", "found[0][0].depth")
    status, said = check_types(layout, wrong)
    assert status == 1 and 'has no attribute "depth"' in said
