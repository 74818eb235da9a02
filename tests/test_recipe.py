"""Recipes: every error is reported before anything runs."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from cyclopts import Parameter

from dmrl import recipe
from dmrl.cli import COMMANDS
from dmrl.errors import RecipeError

Write = Callable[[str], Path]
RECIPES = Path(__file__).parents[1] / "recipes"


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of an imaginary stage."""

    images: int = 10
    rate_hz: float = 1.0
    label: Literal["truth", "hand"] = "truth"
    folder: Path | None = None
    sizes_px: tuple[int, int] = (320, 224)
    share: Annotated[float, Parameter(help="of something")] = 0.5

    def __post_init__(self) -> None:
        if self.images < 0:
            raise ValueError("images: must not be negative")


@dataclass(frozen=True, slots=True)
class RequiredSettings:
    """Settings of an imaginary stage, one of which has no default."""

    robot: str


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return a function that writes a recipe and returns its path."""

    def write_recipe(text: str) -> Path:
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write_recipe


def test_settings_come_from_the_file_and_the_rest_from_the_defaults(write: Write) -> None:
    path = write(
        'kind = "draw"\nimages = 3\nrate_hz = 2\nlabel = "hand"\nfolder = "a/b"\n'
        "sizes_px = [64, 48]\n"
    )
    assert recipe.load(path, "draw", Settings) == Settings(3, 2.0, "hand", Path("a/b"), (64, 48))


def find_keys(error: RecipeError) -> list[str]:
    """Return the keys that a one-line error names."""
    faults = str(error).split(" wrong key", 1)[1].split(": ", 1)[1]
    return [fault.split(":")[0] for fault in faults.split("; ")]


def test_every_wrong_key_is_named(write: Write) -> None:
    path = write('kind = "draw"\nimagse = 3\nrate_hz = "fast"\nlabel = "guess"\n')
    with pytest.raises(RecipeError) as caught:
        recipe.load(path, "draw", Settings)
    assert str(caught.value).startswith(f"{path} has 3 wrong keys: ")
    assert sorted(find_keys(caught.value)) == ["imagse", "label", "rate_hz"]


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("images = 2.5", "images"),
        ("images = true", "images"),
        ('images = "3"', "images"),
        ("sizes_px = [1]", "sizes_px"),
        ("images = -1", "images"),
        ("images = [", None),
    ],
)
def test_values_are_not_coerced(write: Write, line: str, key: str | None) -> None:
    with pytest.raises(RecipeError) as caught:
        recipe.load(write(f'kind = "draw"\n{line}\n'), "draw", Settings)
    if key is None:
        assert "is not TOML" in str(caught.value)
    else:
        assert find_keys(caught.value)[0].startswith(key)


def test_a_setting_without_a_default_must_be_given(write: Write) -> None:
    with pytest.raises(RecipeError, match=r"has 1 wrong key: robot: field required\. Fix it$"):
        recipe.load(write('kind = "fly"\n'), "fly", RequiredSettings)


def test_recipe_of_another_kind_names_the_expected_kind(write: Write) -> None:
    with pytest.raises(RecipeError, match=r"is of kind 'fly'\. .* kind = \"draw\""):
        recipe.load(write('kind = "fly"\n'), "draw", Settings)
    with pytest.raises(RecipeError, match="has no kind"):
        recipe.load(write("images = 3\n"), "draw", Settings)


def test_a_misspelled_shipped_recipe_is_offered() -> None:
    with pytest.raises(RecipeError, match=r"no recipe locanett\. Did you mean locanet\?"):
        recipe.read("locanett")


def test_a_misspelled_file_is_offered_by_its_neighbour(write: Write) -> None:
    beside = write("images = 3\n")
    with pytest.raises(RecipeError, match=rf"Did you mean {beside.name}\?"):
        recipe.read(beside.with_suffix(".tml"))


def test_an_unknown_recipe_lists_the_shipped_ones() -> None:
    with pytest.raises(RecipeError, match=r"no recipe zzz\. Shipped ones: .*locanet"):
        recipe.read("zzz")


def test_an_absent_path_is_a_recipe_error(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="no recipe"):
        recipe.read(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"\xff\xfe\x00", "cannot be read"), (b"kind = ", "is not TOML"), (b"\x00", "is not TOML")],
)
def test_files_that_are_not_toml_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(RecipeError, match=words) as caught:
        recipe.read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_named_like_a_recipe_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "folder.toml"
    path.mkdir()
    with pytest.raises(RecipeError, match="no recipe"):
        recipe.read(path)


def test_a_file_too_long_for_a_recipe_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "large.toml"
    path.write_text("#" * 400_001, encoding="utf-8")
    with pytest.raises(RecipeError, match="has more than 400000 bytes"):
        recipe.read(path)


@pytest.mark.parametrize("name", recipe.list_names() + recipe.list_pretrained_names())
def test_shipped_recipes_start_with_purpose_and_command(name: str) -> None:
    head = recipe.read_text(name).partition("\n\n")[0].splitlines()
    assert all(line.startswith("# ") for line in head)
    sentence = " ".join(line for line in head if not line.startswith("# dmrl "))
    assert sentence.endswith(".")
    commands = [line.split()[2] for line in head if line.startswith("# dmrl ")]
    assert commands
    assert set(commands) <= set(COMMANDS)


def test_shipped_recipes_equal_the_folder() -> None:
    assert recipe.list_names() == sorted(path.stem for path in RECIPES.glob("*.toml"))
    trained = sorted(path.stem for path in RECIPES.glob("pretrained/*.toml"))
    assert recipe.list_pretrained_names() == trained
    assert not set(trained) & set(recipe.list_names())


def test_pretrained_recipes_are_found_by_name() -> None:
    path = RECIPES / "pretrained/nano_clean.toml"
    assert (
        recipe.read_text("nano_clean") == recipe.read_text(path) == path.read_text(encoding="utf-8")
    )
    with pytest.raises(RecipeError, match=r"no recipe nano_claen\. Did you mean nano_clean\?"):
        recipe.read("nano_claen")
    with pytest.raises(RecipeError, match=r"week; those of the shipped networks: nano_clean, "):
        recipe.read("zzz")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a = " + "[" * 90_000, "nests deeper"),
        (f"[{'a.' * 10_000}a]", "nests deeper"),
        ("a" + ".a" * 5_000 + " = 1", "nests deeper"),
        ("# " + "a" * 100_000, "characters"),
    ],
    ids=["lists", "tables", "dotted keys", "long"],
)
@pytest.mark.heavy
def test_depth_and_length_of_a_recipe_have_a_budget(
    write: Write, text: str, complaint: str
) -> None:
    with pytest.raises(RecipeError, match=complaint):
        recipe.read(write(text))


def test_a_setting_may_have_the_name_of_a_pydantic_method(write: Write) -> None:
    @dataclass(frozen=True)
    class Copied:
        copy: bool = True

    path = write('kind = "draw"\ncopy = false\n')
    assert recipe.load(path, "draw", Copied) == Copied(copy=False)


def test_unknown_key_suggests_the_nearest() -> None:
    (fault,) = recipe.find_faults({"gat_m": 0.3}, _load_label_settings())
    assert fault == "gat_m: extra inputs are not permitted (did you mean gate_m?)"


def test_bucket_paths_are_kept() -> None:
    made = recipe.check("x", {"sensors": "s3://lab/sensors.toml"}, _load_label_settings())
    assert str(made.sensors) == "s3://lab/sensors.toml"


def _load_label_settings() -> Any:
    """Return the settings class of `dmrl label`."""
    return import_module("dmrl.stages.label").Settings
