"""Limits of render settings, presets and shipped recipes."""

import pytest

from dmrl.errors import RecipeError
from dmrl.render_recording import read_render_settings
from dmrl.rendering.settings import PRESETS, Settings


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_makes_valid_settings(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("recipe") / "r.toml"
    path.write_text(f'kind = "render"\npreset = "{name}"\nimages = 3\n')
    assert read_render_settings(str(path)).images == 3


@pytest.mark.parametrize(
    ("name", "images"),
    [("synthetic_first_look", 40), ("synthetic_paper", 1000), ("synthetic_large", 20_000)],
)
def test_shipped_recipes_have_their_documented_number_of_images(name: str, images: int) -> None:
    assert read_render_settings(name).images == images
    assert read_render_settings(name, images=2, seed=None).images == 2


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"depth_m": (3.0, 1.0)}, "depth_m: .* ends before it begins"),
        ({"robots_max": 0}, "robots_max: 0 is not within 1 to 20"),
        ({"scale": -1.0}, "scale: -1.0 is not within"),
        ({"brightness": (float("nan"), 0.5)}, "brightness"),
    ],
)
def test_impossible_values_are_refused(changes: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Settings(**changes)  # type: ignore[arg-type]


def test_a_wrong_preset_or_kind_is_named(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("recipe") / "r.toml"
    path.write_text('kind = "render"\npreset = "himx"\n')
    with pytest.raises(RecipeError, match=r"no preset 'himx'. There are: himax"):
        read_render_settings(str(path))
    path.write_text('kind = "train"\n')
    with pytest.raises(RecipeError, match="kind 'train'"):
        read_render_settings(str(path))
