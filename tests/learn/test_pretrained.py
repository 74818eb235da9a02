"""The networks that ship with dmrl."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import ModelError
from dmrl.images.codec import decode
from dmrl.learn import pretrained
from dmrl.learn.inference.decode_grids import decode as find
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.networks.architectures import count_macs, count_parameters

FRAMES = {"img00185.ppm": (174, 65), "img00375.ppm": (298, 139), "img00495.ppm": (98, 131)}
"""Pixel of the drone in real frames of the AI-deck, read by eye."""


@pytest.mark.parametrize("name", pretrained.list_pretrained())
def test_pretrained_networks_are_small_and_have_a_model_card(name: str) -> None:
    folder = pretrained.resolve_model_path(Path(name))
    model = load_model(folder)
    assert (folder / "model.safetensors").stat().st_size < 200_000
    assert count_parameters(model.network) <= 25_000
    assert count_macs(model.network) <= 80_000_000
    assert f"dmrl predict {name}" in (folder / "README.md").read_text(encoding="utf-8")


def test_a_folder_of_that_name_is_preferred_to_the_shipped_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert pretrained.resolve_model_path(Path("dmrl-nano")).is_absolute()
    (tmp_path / "dmrl-nano").mkdir()
    assert pretrained.resolve_model_path(Path("dmrl-nano")) == Path("dmrl-nano")


def test_an_unknown_name_is_refused_with_the_names_of_shipped_networks(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"no model .*nano-dmrl.*ships with dmrl: dmrl-nano"):
        load_model(pretrained.resolve_model_path(tmp_path / "nano-dmrl"))


@pytest.mark.parametrize("name", FRAMES)
def test_dmrl_nano_finds_the_drone_in_real_frames(data: Path, name: str) -> None:
    file = data / "aideck-frames" / name
    model = load_model(pretrained.resolve_model_path(Path("dmrl-nano")))
    found = find(*model.grids(decode(file.read_bytes(), file)[None]), stride_px=8)
    seen = found.u_px[0, 0], found.v_px[0, 0]
    assert np.hypot(*np.subtract(seen, FRAMES[name])) < 16
    assert found.confidence[0, 0] > model.threshold
