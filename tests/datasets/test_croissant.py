"""The Croissant description of a dataset is valid and loads its rows."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.datasets import open_dataset
from dmrl.stages.card import Settings as CardSettings
from dmrl.stages.card import run as run_card
from dmrl.stages.dataset import Settings, run

from .conftest import Record, draw_noise

mlcroissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
IGNORE_DEPRECATIONS = pytest.mark.filterwarnings("ignore::DeprecationWarning")
"""For warnings from the libraries that read Croissant."""


@IGNORE_DEPRECATIONS
@pytest.mark.parametrize("parquet", [False, True])
@pytest.mark.heavy
def test_croissant_is_valid_and_names_every_column(
    record: Record, tmp_path: Path, parquet: bool
) -> None:
    spans = {"train": "[[0, 250000000]]", "test": "[[300000000, 900000000]]"}
    run([record(split=spans)], tmp_path / "out", Settings(parquet=parquet, license="cc0-1.0"))
    run_card(tmp_path / "out", CardSettings(published="2026-11-27"))
    found = mlcroissant.Dataset(jsonld=str(tmp_path / "out" / "croissant.json"))
    assert not found.metadata.ctx.issues.errors
    assert not found.metadata.ctx.issues.warnings
    assert [one.name for one in found.metadata.record_sets] == ["train", "test"]
    opened = open_dataset(tmp_path / "out").split("train")
    names = [field.name for field in found.metadata.record_sets[0].fields]
    assert names == opened.table.schema.names
    assert all(field.description for field in found.metadata.record_sets[0].fields)
    assert found.metadata.license == ["cc0-1.0"]
    assert found.metadata.version == "1.0.0" and "@misc{" in found.metadata.cite_as
    assert found.metadata.date_published.date().isoformat() == "2026-11-27"


@IGNORE_DEPRECATIONS
@pytest.mark.heavy
def test_croissant_loads_the_rows_of_parquet(record: Record, tmp_path: Path) -> None:
    run([record()], tmp_path / "out", Settings(split="none", parquet=True))
    found = mlcroissant.Dataset(jsonld=str(tmp_path / "out" / "croissant.json"))
    rows = list(found.records("train"))
    assert len(rows) == 6
    assert np.array_equal(np.asarray(rows[3]["train/image"]), draw_noise(3))
    assert rows[3]["train/peers"][0]["train/peers/u_px"] == 20.5
    assert rows[3]["train/log_time"] == 300_000_000
