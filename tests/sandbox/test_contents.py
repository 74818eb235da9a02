"""Names and numbers in untrusted datasets and models become no path, code or NaN."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.deploy.int8.store import INTEGER_NAME
from dmrl.images.codec import encode_png

from ..deploy.networks import random_network
from .box import (
    ELSEWHERE,
    HOSTILE_TEXT,
    Box,
    assert_untouched,
    run_and_capture,
    run_command,
    write_hostile_recording,
    write_quantized_model,
)


@pytest.mark.heavy
@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize("split", ELSEWHERE)
def test_a_split_of_a_recording_stays_in_the_dataset(
    split: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    name = split.replace("{victim}", str(box.victim))
    bad = write_hostile_recording(box.root / "in" / "bad.mcap", {name: "[[0, 900000000]]"})
    for extra in ((), ("--parquet",)):
        for mode in ("auto", "recordings"):
            run_command(
                box,
                capsys,
                "dataset",
                bad,
                box.out / f"{mode}{len(extra)}",
                "--split",
                mode,
                *extra,
            )
    assert not any("keep" in path.name for path in box.out.rglob("*"))


@pytest.mark.parametrize("extra", [(), ("--parquet",)], ids=["arrow", "parquet"])
@pytest.mark.heavy
def test_splits_whose_folders_would_coincide_are_refused(
    extra: tuple[str, ...], box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    halves = {"near": "[[0, 100000001]]", "Near": "[[200000000, 900000000]]"}
    bad = write_hostile_recording(box.root / "in" / "bad.mcap", halves, ("cf1",))
    words = ("dataset", bad, box.out / "set", "--split", "auto", *extra)
    status, output = run_and_capture(box, capsys, *words)
    assert status == 1 and "the splits near and Near differ only in case" in output
    assert list(box.out.iterdir()) == []


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize("split", ELSEWHERE)
@pytest.mark.heavy
def test_a_split_of_a_label_table_stays_in_the_dataset(
    split: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    name = split.replace("{victim}", str(box.victim))
    folder = box.root / "in" / "pictures"
    folder.mkdir()
    (folder / "000000000000.png").write_bytes(encode_png(np.zeros((48, 64, 3), np.uint8)))
    rows = f'file,peer,u_px,v_px,depth_m,split\n000000000000.png,cf2,3,4,1,"{name}"\n'
    (folder / "labels.csv").write_text(rows)
    out = box.out / "x.mcap"
    status = run_command(box, capsys, "convert", folder, out, "--from", "images")
    assert (status == 0) == (name in ("", "-rf"))
    if status == 0:
        run_command(box, capsys, "dataset", out, box.out / "set", "--split", "auto")


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.heavy
def test_hostile_dataset_changes_nothing_outside_its_folder(
    box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = write_hostile_recording(box.root / "in" / "bad.mcap")
    good = box.out / "set"
    assert run_command(box, capsys, "dataset", bad, good, "--split", "recordings") == 0
    card = (good / "README.md").read_text()
    assert "<img" not in card.replace("`", "")
    assert "\n# x" not in card
    for edit in (
        lambda d: (
            (d / "manifest.json").unlink(),
            (d / "dataset_dict.json").write_text('{"splits": ["../../victim"]}'),
        ),
        lambda d: (
            (d / "manifest.json").unlink(),
            (d / "dataset_dict.json").write_text('{"splits": [3, null]}'),
        ),
        lambda d: (d / "manifest.json").write_text(
            (d / "manifest.json").read_text().replace("data-", "../../../victim/data-")
        ),
        lambda d: (d / "manifest.json").write_text(
            (d / "manifest.json").read_text().replace('"train"', '"../../victim"')
        ),
        lambda d: (
            (d / "manifest.json").unlink(),
            (d / "train/state.json").write_text(
                json.dumps({"_data_files": [{"filename": "../../../victim/keep"}]})
            ),
        ),
        lambda d: (shutil.rmtree(d / "figures"), (d / "figures").symlink_to(box.victim)),
        lambda d: ((d / "README.md").unlink(), (d / "README.md").symlink_to(box.victim / "keep")),
        lambda d: (d / "provenance.json").write_text('{"stage": "*/", "inputs": [' * 2000),
        lambda d: (d / "provenance.json").write_text("[" * 100_000),
        lambda d: (d / "provenance.json").write_text('{"inputs": [], "settings": "x"}'),
    ):
        hurt = box.out / "hurt"
        shutil.copytree(good, hurt)
        (hurt / "figures").mkdir(exist_ok=True)
        edit(hurt)
        run_command(box, capsys, "card", hurt)
        run_command(
            box, capsys, "train", hurt, box.out / "run", "--epochs", "1", "--batch-size", "0"
        )
        shutil.rmtree(hurt)


def build_model_arrays(box: Box) -> tuple[Path, dict[str, Any]]:
    """Write a valid quantized model; return its folder and the arrays of its int8 network."""
    folder = write_quantized_model(box.root / "in" / "model", random_network(0))
    with np.load(folder / INTEGER_NAME) as archive:
        return folder, {name: archive[name] for name in archive.files}


def assert_export_refuses(box: Box, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that export refuses the model's int8 network and writes nothing."""
    folder = box.root / "in" / "model"
    words = ["export", str(folder), str(box.out / "x")]
    with assert_untouched(box):
        assert boundary.run_to_status(lambda: app(words)) == 1
    output = capsys.readouterr().err
    assert "internal error" not in output
    assert "Quantise" in output, output
    assert list(box.out.iterdir()) == []


@pytest.mark.heavy
def test_a_model_s_names_do_not_become_code(box: Box, capsys: pytest.CaptureFixture[str]) -> None:
    network = random_network(0)
    layers = tuple(
        replace(layer, name=f"{HOSTILE_TEXT}{k}") for k, layer in enumerate(network.layers)
    )
    bad = replace(network, name=HOSTILE_TEXT, architecture=HOSTILE_TEXT, layers=layers)
    folder, written = write_quantized_model(box.root / "in" / "model", bad), box.out / "exported"
    assert run_command(box, capsys, "export", folder, written) == 0
    for words in (
        ("verify", folder),
        ("predict", folder, folder, box.out / "x.mcap"),
        ("quantize", folder, folder, box.out / "q"),
    ):
        run_command(box, capsys, *words)
    texts = [path.read_text() for path in written.iterdir() if path.suffix in (".c", ".h", "")]
    assert len(texts) > 3
    assert not any("/etc/passwd" in text or "$(shell touch" in text for text in texts)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("width_px",), "1); system(0"),
        (("name",), 3),
        (("threshold",), float("nan")),
        (("threshold",), "0.5"),
        (("layers", 0, "stride"), "1 */"),
        (("layers", 0, "stride"), 0),
        (("layers", 0, "source"), 10**30),
        (("layers", 0, "scale"), float("inf")),
        (("heads", "confidence", "tensor"), 99),
        (("heads", "confidence", "channel"), "0"),
        (("layers",), 7),
        (("layers", 0), None),
        (("layers", 0, "name"), "conv1"),  # the name of another layer
        (("heads",), []),
    ],
)
def test_invalid_numbers_in_a_model_are_refused(
    path: tuple[Any, ...], value: Any, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, arrays = build_model_arrays(box)
    said = json.loads(arrays.pop("description").tobytes())
    place = said
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    text = np.frombuffer(json.dumps(said).encode(), np.uint8)
    np.savez(folder / INTEGER_NAME, description=text, **arrays)
    assert_export_refuses(box, capsys)


@pytest.mark.parametrize("name", ["layer0.bias", "layer0.multiplier"])
@pytest.mark.parametrize("size", [0, 1])
def test_model_must_have_a_number_for_each_channel(
    name: str, size: int, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, arrays = build_model_arrays(box)
    np.savez(folder / INTEGER_NAME, **arrays | {name: arrays[name][:size]})
    assert_export_refuses(box, capsys)
