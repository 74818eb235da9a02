"""`dmrl train`: reproducibility, resumption, settings and errors."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import recipe
from dmrl.cli import app
from dmrl.datasets import open_dataset
from dmrl.datasets.training_examples import build_examples, load_training_data
from dmrl.errors import DatasetError, ModelError, OutputError, SettingError
from dmrl.images.codec import encode_png
from dmrl.labelling import unlabelled_training
from dmrl.learn.data.batches import ROBOT_FIELDS
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.training import trainer
from dmrl.stages import convert, dataset, train
from dmrl.stages.train import Flags, Settings, run

from .trainings import SETTINGS

pytestmark = pytest.mark.heavy


def test_run_folder_records_training_and_provenance(dots_dataset: Path, tmp_path: Path) -> None:
    result = run(dots_dataset, tmp_path / "run", SETTINGS)
    assert result.images == 20
    model = load_model(tmp_path / "run")
    assert (model.width_px, model.height_px, model.label_source) == (64, 48, "truth")
    assert model.training["images"] == 20
    assert [epoch["loss"] for epoch in model.training["history"]][-1] == result.loss
    made = json.loads((tmp_path / "run" / "provenance.json").read_text())
    assert made["stage"] == "train"
    assert made["settings"]["epochs"] == 2
    assert made["inputs"][0]["provenance"]["inputs"][0]["name"] == "dots.mcap"
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {"model.json", "model.safetensors", "provenance.json", "tensorboard"}


def test_same_inputs_same_weights(dots_dataset: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        run(dots_dataset, tmp_path / name, SETTINGS)
    for name in ("model.safetensors", "model.json", "provenance.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_share_of_the_first_weights_is_kept(dots_dataset: Path, tmp_path: Path) -> None:
    run(dots_dataset, tmp_path / "a", SETTINGS)
    for share in (0.0, 0.25, 1.0):
        more = replace(SETTINGS, init_share=share, seed=1)
        run(dots_dataset, tmp_path / f"b{share}", more, init=tmp_path / "a")
    first, trained, mixed, back = (
        load_model(tmp_path / name).network.state_dict()["body.0.0.weight"]
        for name in ("a", "b0.0", "b0.25", "b1.0")
    )
    assert (trained != first).any()
    np.testing.assert_allclose(back, first, atol=1e-6)
    np.testing.assert_allclose(mixed, 0.25 * first + 0.75 * trained, atol=1e-6)
    with pytest.raises(SettingError, match="requires an initial model"):
        run(dots_dataset, tmp_path / "c", replace(SETTINGS, init_share=0.5))


def test_init_starts_from_the_weights_of_a_model(dots_dataset: Path, tmp_path: Path) -> None:
    slow = replace(SETTINGS, learning_rate=1e-9, final_learning_rate=0.0)
    run(dots_dataset, tmp_path / "a", SETTINGS)
    run(dots_dataset, tmp_path / "b", slow, init=tmp_path / "a")
    first, second = (load_model(tmp_path / name).network.state_dict() for name in ("a", "b"))
    np.testing.assert_allclose(first["head.weight"], second["head.weight"], atol=1e-6)
    made = json.loads((tmp_path / "b" / "provenance.json").read_text())
    assert [source["name"] for source in made["inputs"]] == ["dots", "a"]


def test_auto_takes_the_network_of_init(dots_dataset: Path, tmp_path: Path) -> None:
    auto = replace(SETTINGS, architecture="auto", epochs=1, epoch_images=4)
    run(dots_dataset, tmp_path / "fine", replace(auto, architecture="dmrl-nano-fine"))
    run(dots_dataset, tmp_path / "on", auto, init=tmp_path / "fine")
    run(dots_dataset, tmp_path / "new", auto)
    named = [load_model(tmp_path / name).architecture for name in ("on", "new")]
    assert named == ["dmrl-nano-fine", "dmrl-nano"]
    made = json.loads((tmp_path / "on" / "provenance.json").read_text())
    assert made["settings"]["architecture"] == "dmrl-nano-fine"


def test_a_teacher_is_learnt_from_and_named(dots_dataset: Path, tmp_path: Path) -> None:
    taught = replace(SETTINGS, distill_share=1.0)
    run(dots_dataset, tmp_path / "teacher", replace(SETTINGS, architecture="dmrl-large"))
    run(dots_dataset, tmp_path / "a", taught, teacher=tmp_path / "teacher")
    run(dots_dataset, tmp_path / "b", taught)
    first, second = (load_model(tmp_path / name).network.state_dict() for name in ("a", "b"))
    assert not np.allclose(first["head.weight"], second["head.weight"])
    made = json.loads((tmp_path / "a" / "provenance.json").read_text())
    assert [source["name"] for source in made["inputs"]] == ["dots", "teacher"]


def test_classes_are_patterns_of_peer_names(dots_dataset: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, classes=("cf9", "cf*"), spread_weight=1.0)
    with pytest.raises(SettingError, match=r"classes: cf9 matches no peer .* Choose among cf2$"):
        run(dots_dataset, tmp_path / "run", settings)
    settings = replace(settings, classes=("cf2", "cf*"))
    with pytest.raises(SettingError, match=r"classes: cf\* matches no peer"):
        run(dots_dataset, tmp_path / "run", settings)
    run(dots_dataset, tmp_path / "plain", SETTINGS)
    settings = replace(settings, classes=("cf2",))
    run(dots_dataset, tmp_path / "more", settings, init=tmp_path / "plain")
    outputs = json.loads((tmp_path / "more" / "model.json").read_text())["outputs"]
    assert outputs[4:] == ["log_spread", "class_0"]


KILLED = """
import sys, time
from pathlib import Path
from dmrl.images.codec import encode_png
from dmrl.learn.training import trainer
from dmrl.stages.train import Settings, run
step = trainer.train_step
checkpoint = Path(sys.argv[2] + ".partial", "checkpoint.json")
def until_the_first_checkpoint(*args):
    if checkpoint.exists():
        time.sleep(1000)  # until it is killed
    return step(*args)
trainer.train_step = until_the_first_checkpoint
run(
    Path(sys.argv[1]),
    Path(sys.argv[2]),
    Settings(epochs=4, batch_size=4, device="cpu", validation_share=0.0),
)
"""


def assert_training_resumes(dataset: Path, out: Path, settings: Settings) -> None:
    """Assert that a training resumes, only on request, to the weights of an uninterrupted one."""
    partial, whole = out.with_name(f"{out.name}.partial"), out.with_name("whole")
    assert partial.is_dir()
    assert not out.exists()
    with pytest.raises(OutputError, match=r"holds an interrupted training\. Go on with --resume"):
        run(dataset, out, settings)
    run(dataset, out, settings, resume=True)
    run(dataset, whole, settings)
    assert not partial.exists()
    weights = [(folder / "model.safetensors").read_bytes() for folder in (out, whole)]
    assert weights[0] == weights[1]


def test_interrupted_training_resumes_to_the_same_bytes(
    dots_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    steps, step = count(), trainer.train_step

    def interrupt(*args: Any) -> Any:
        if next(steps) == 7:  # the third of five steps of the second epoch
            raise KeyboardInterrupt
        return step(*args)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(trainer, "train_step", interrupt)
        run(dots_dataset, out, SETTINGS)
    assert_training_resumes(dots_dataset, out, SETTINGS)


@pytest.mark.parametrize("began", [False, True])
def test_an_interrupted_training_says_how_to_go_on(
    began: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        if began:
            (tmp_path / "few.partial").mkdir()
            (tmp_path / "few.partial/checkpoint.json").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(unlabelled_training, "train_with_flights", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train.command(tmp_path / "dataset", tmp_path / "few")
    words = "few.partial holds the epochs done. Go on with the same command and --resume"
    assert (words in capsys.readouterr().err) == began


@pytest.mark.slow
def test_killed_training_resumes_to_the_same_bytes(dots_dataset: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, epochs=4)
    out, partial = tmp_path / "run", tmp_path / "run.partial"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(dots_dataset), str(out)])
    while not (partial / "checkpoint.json").exists():
        assert process.poll() is None, "it ended before it could be killed"
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert_training_resumes(dots_dataset, out, settings)


def test_a_training_killed_in_its_first_epoch_starts_over(
    dots_dataset: Path, tmp_path: Path
) -> None:
    (tmp_path / "run.partial" / "tensorboard").mkdir(parents=True)
    run(dots_dataset, tmp_path / "run", SETTINGS, resume=True)
    (tmp_path / "again.partial" / "tensorboard").mkdir(parents=True)
    run(dots_dataset, tmp_path / "again", SETTINGS)
    weights = [(tmp_path / n / "model.safetensors").read_bytes() for n in ("run", "again")]
    assert weights[0] == weights[1]


def test_invalid_training_gives_one_line_error(dots_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"to resume\. Train without --resume"):
        run(dots_dataset, tmp_path / "run", SETTINGS, resume=True)
    with pytest.raises(DatasetError, match="dmrl dataset"):
        run(tmp_path / "nothing", tmp_path / "run", SETTINGS)
    with pytest.raises(ModelError, match="no model"):
        run(dots_dataset, tmp_path / "run", SETTINGS, init=tmp_path / "nothing")
    with pytest.raises(SettingError, match="is a dmrl-nano, not the locanet to train"):
        run(
            dots_dataset,
            tmp_path / "run",
            replace(SETTINGS, architecture="locanet"),
            init=Path("dmrl-nano"),
        )
    with pytest.raises(SettingError, match="no architecture resnet"):
        run(dots_dataset, tmp_path / "run", replace(SETTINGS, architecture="resnet"))
    (tmp_path / "taken").mkdir()
    with pytest.raises(OutputError, match="exists"):
        run(dots_dataset, tmp_path / "taken", SETTINGS)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_training_needs_images_with_robots(tmp_path: Path) -> None:
    shots = tmp_path / "shots"
    shots.mkdir()
    for name in ("a", "b"):
        (shots / f"{name}.png").write_bytes(encode_png(np.zeros((64, 64, 3), np.uint8)))
    table = "file,peer,u_px,v_px,depth_m\na.png,,,,\nb.png,,,,\n"
    (shots / "labels.csv").write_text(table, encoding="utf-8")
    convert.run(shots, tmp_path / "shots.mcap", convert.Settings())
    dataset.run([tmp_path / "shots.mcap"], tmp_path / "dataset", dataset.Settings())
    with pytest.raises(DatasetError, match=r"no robot in any of the 2 images.*--add"):
        run(tmp_path / "dataset", tmp_path / "run", SETTINGS)


def test_shipped_recipe_is_the_default_and_locanet_follows_the_paper() -> None:
    assert recipe.load("dmrl_nano", "train", Settings) == Settings()
    published = recipe.load("locanet", "train", Settings)
    assert published.augmentation(0).is_identity
    assert (published.architecture, published.epochs, published.batch_size) == ("locanet", 15, 5)
    for name in recipe.list_names() + recipe.list_pretrained_names():
        if recipe.read(name)["kind"] == "train":
            recipe.load(name, "train", Settings)


def test_the_threshold_is_chosen_on_images_held_out(dots_dataset: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, validation_share=0.2)
    run(dots_dataset, tmp_path / "run", settings)
    model = load_model(tmp_path / "run")
    assert model.training["images"] == 16
    promise = model.training["threshold"]
    assert promise["empty images"] == 100 and "rooms" in promise["they are of"]
    assert promise["false alarms an empty image"] <= promise["false alarms allowed"] == 0.02
    assert "validation_ap_16_px" in model.training["history"][0]
    run(dots_dataset, tmp_path / "given", replace(settings, threshold=0.45))
    assert load_model(tmp_path / "given").threshold == 0.45


def test_examples_carry_every_peer_with_its_box(dots_dataset: Path) -> None:
    split = open_dataset(dots_dataset).split("train")
    examples = build_examples(split)
    for robots, peers in zip(examples.robots, split.table.column("peers").to_pylist(), strict=True):
        found = robots[np.isfinite(robots[:, 0])]
        assert len(found) == len(peers)
        for robot, peer in zip(found, peers, strict=True):
            np.testing.assert_allclose(robot[:6], [peer[n] for n in ROBOT_FIELDS[:6]], rtol=1e-6)
            if peer["box_px"]:
                np.testing.assert_allclose(robot[6:], peer["box_px"], rtol=1e-6)


def test_the_last_images_of_a_recording_are_held_out(dots_dataset: Path) -> None:
    every = build_examples(open_dataset(dots_dataset).split("train"))
    found = load_training_data(open_dataset(dots_dataset), Settings(validation_share=0.25))
    assert (len(found.examples), found.shares) == (15, None)
    assert found.held_out is not None
    joined = np.concatenate([found.examples.robots, found.held_out.robots])
    np.testing.assert_array_equal(joined, every.robots)
    np.testing.assert_array_equal(found.held_out.get_image(0), every.get_image(15))
    assert (
        load_training_data(open_dataset(dots_dataset), Settings(validation_share=0.0)).held_out
        is None
    )


def test_shares_select_recordings_by_name(dots_dataset: Path, tmp_path: Path) -> None:
    run(dots_dataset, tmp_path / "run", replace(SETTINGS, shares={"dots*": 0.7}))
    with pytest.raises(SettingError, match=r"no images left for flight-\*.*are dots\.mcap"):
        run(dots_dataset, tmp_path / "a", replace(SETTINGS, shares={"flight-*": 1.0, "*": 1.0}))
    with pytest.raises(SettingError, match=r"shares: all are 0"):
        run(dots_dataset, tmp_path / "b", replace(SETTINGS, shares={"*": 0.0}))


def test_flags_win_over_the_recipe(dots_dataset: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(
        'kind = "train"\nepochs = 7\nbatch_size = 10\nwarmup_epochs = 0\ndevice = "cpu"\n'
    )
    words = ["train", str(dots_dataset), str(tmp_path / "run"), "--recipe", str(mine)]
    app([*words, "--epochs", "1", "--seed", "0"], result_action="return_value")
    said = load_model(tmp_path / "run").training["settings"]
    assert (said["epochs"], said["batch_size"], said["warmup_epochs"]) == (1, 10, 0)


def test_flag_out_of_range_gives_one_line_error() -> None:
    with pytest.raises(SettingError, match="epochs: must be between 0 and"):
        recipe.load("dmrl_nano", "train", Settings, Flags(epochs=-1))


def test_no_epochs_calibrate_a_model_and_train_nothing(dots_dataset: Path, tmp_path: Path) -> None:
    none = Flags(epochs=0, device="cpu")
    with pytest.raises(SettingError, match="epochs: 0 trains nothing"):
        train.command(dots_dataset, tmp_path / "run", flags=none)
    train.command(dots_dataset, tmp_path / "run", flags=Flags(epochs=1, device="cpu"))
    train.command(dots_dataset, tmp_path / "again", init=tmp_path / "run", flags=none)
    before, after = (load_model(tmp_path / name).network for name in ("run", "again"))
    heads = {"head.weight", "head.bias"}
    names = before.state_dict().keys() - heads
    assert all(bool((before.state_dict()[k] == after.state_dict()[k]).all()) for k in names)


def test_json_names_the_model(
    dots_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train.command(dots_dataset, tmp_path / "run", flags=Flags(epochs=1, device="cpu"), as_json=True)
    output = json.loads(capsys.readouterr().out)
    assert output["model"] == str(tmp_path / "run")
    assert output["images"] == 18  # two are held out for the choice of the threshold
