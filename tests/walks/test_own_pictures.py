"""Hand-labelled images of an own camera, converted to a dataset with a card."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.images.codec import encode_png
from dmrl.stages import convert, dataset

pytestmark = pytest.mark.slow


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Return 30 labelled images and one without a label; all labels are 10 px too low."""
    folder = tmp_path / "hall"
    folder.mkdir()
    (folder / "LICENSE").write_text("CC BY 4.0\n")
    rng = np.random.default_rng(0)
    lines = [
        "file,peer,u_px,v_px,depth_m,left_px,top_px,right_px,bottom_px,source,sigma_u_px,sigma_v_px"
    ]
    for k in range(30):
        rgb = rng.integers(0, 256, (112, 160, 3), np.uint8)
        (folder / f"{k:03d}.png").write_bytes(encode_png(rgb))
        u, v = rng.uniform(30, 120), rng.uniform(30, 70)
        box = f"{u - 12:.1f},{v - 8:.1f},{u + 12:.1f},{v + 8:.1f}"
        lines.append(f"{k:03d}.png,cf2,{u:.2f},{v + 10:.2f},1.5,{box},hand,2.0,3.0")
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")
    (folder / "900.png").write_bytes(encode_png(rgb))
    return folder


def test_own_images_become_a_dataset_with_a_complete_card(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "hall.mcap"
    convert.run(pictures, recording, convert.Settings())
    # The bias is already reported by the conversion.
    assert "labels of source 'hand' are biased: " in capsys.readouterr().err
    with pytest.raises(SettingError, match="has no masks"):
        dataset.run([recording], tmp_path / "d", dataset.Settings(masks=True))
    with pytest.raises(SettingError, match="neither SPDX nor"):
        dataset.run([recording], tmp_path / "d", dataset.Settings(license="ccby"))
    dataset.run([recording], tmp_path / "d", dataset.Settings(license="cc-by-4.0"))
    assert "left out: images that had no labels: 1" in capsys.readouterr().err
    card = (tmp_path / "d" / "README.md").read_text()
    for line in (
        "30 of 30 have a sigma, median 2.0 px in u, 3.0 px in v",
        "labels of source 'hand' are biased: ",
        "- Left out: images that had no labels: 1.",
        "- Leaks: no images",
        "- Licence of `hall`: CC BY 4.0.",
    ):
        assert line in card
