"""Quantise the shipped networks, and store the int8 networks beside their weights.

    python benchmarks/ship_int8.py [RECORDING ...]

The activation ranges come from the images of the recordings and from 400 drawings of `dmrl sketch`.
Run this, or `make int8`, when a shipped network has changed. A test fails if an int8 network does
not belong to the weights beside it.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

import dmrl
from dmrl.deploy.int8.store import INTEGER_NAME
from dmrl.deploy.samples import SAMPLES_NAME, save_samples
from dmrl.learn.pretrained import PRETRAINED_DIR, list_pretrained

SAMPLES = 1
"""Number of drawings that ship with each network, as inputs of the self-test of its C."""


def draw(folder: Path) -> Path:
    """Draw 400 images and return their recording."""
    dmrl.sketch(folder / "drawn", images=400, seed=77)
    return dmrl.convert(folder / "drawn", folder / "drawn.mcap").path


def main(recordings: list[str]) -> None:
    """Quantise every shipped network."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        drawn = draw(folder)
        data = dmrl.make_dataset([drawn, *recordings], folder / "dataset")
        samples = dmrl.open(drawn).images()[:SAMPLES].to_numpy()
        for name in list_pretrained():
            dmrl.quantize(name, data, folder / name, images=600)
            shutil.copyfile(folder / name / INTEGER_NAME, PRETRAINED_DIR / name / INTEGER_NAME)
            save_samples(samples, PRETRAINED_DIR / name)
            said = json.loads((folder / name / "quantisation.json").read_text(encoding="utf-8"))
            size = (PRETRAINED_DIR / name / SAMPLES_NAME).stat().st_size
            print(name, size, json.dumps(said)[:1500])


if __name__ == "__main__":
    main(sys.argv[1:])
