"""Plots of `dmrl evaluate`, and the error without matplotlib."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dmrl.errors import MissingExtra, OutputError
from dmrl.evaluation import evaluate_recordings
from dmrl.stages import predict
from dmrl.stages.evaluate import run

from .test_evaluate import FAST


@pytest.mark.heavy
def test_plots_are_complete_and_reproducible(dots: Path, model: Path, tmp_path: Path) -> None:
    predict.run(model, dots, tmp_path / "out.mcap", predict.Settings())
    for name in ("a", "b"):
        run([tmp_path / "out.mcap"], tmp_path / name, FAST)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    plots = ("circles", "error-by-distance", "error-violins", "examples")
    assert names == sorted(
        [*(f"{p}.{s}" for p in plots for s in ("png", "svg")), "evaluation.json"]
    )
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with Image.open(tmp_path / "a" / "error-violins.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("L")))) > 50
    with pytest.raises(OutputError, match="exists"):
        run([tmp_path / "out.mcap"], tmp_path / "a", FAST)


def test_plots_without_matplotlib_name_the_extra(
    dots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate_recordings, "figures", None)
    with pytest.raises(MissingExtra, match=r"pip install 'dmrl\[plot\]'"):
        run([dots], tmp_path / "plots", FAST)
