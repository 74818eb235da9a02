"""The exported C also compiles as C++, and a C++ program links with it in both forms."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.c import write_c
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import decode_detections, run_network

from .graphs import quantised_network
from .test_c import draw_images
from .test_memories import find_least_near_bytes, find_splittable

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
COMPILERS = {
    "gcc": ("gcc", "-std=c99"),
    "clang": ("clang", "-std=c99"),
    "g++": ("g++", "-x", "c++", "-std=c++11"),
    "clang++": ("clang++", "-x", "c++", "-std=c++11"),
    "g++, C++20": ("g++", "-x", "c++", "-std=c++20"),
}
PROGRAM = """
#include "random.h"
#include <cstdio>
#include <vector>

int main()
{
    static random_t net;
    FARstd::vector<uint8_t> image(RANDOM_IMAGE_BYTES);
    if (std::fread(image.data(), 1, image.size(), stdin) != image.size())
        return 1;
    random_detection_t found[5];
    const int count = random_run(STATE, image.data(), found, 5);
    for (int k = 0; k < count; k++)
        std::printf("%d %d %d\\n", int(found[k].u_q4), int(found[k].v_q4), int(found[k].depth_mm));
}
"""


def write_network(folder: Path, kind: str) -> IntegerNetwork:
    """Write the C of a network, plain or with two memories."""
    network = find_splittable(1) if kind == "two memories" else quantised_network(1)
    near = find_least_near_bytes(network) if kind == "two memories" else None
    write_c(network, folder, [], near_bytes=near)
    return network


def find_compiler(name: str) -> tuple[str, ...]:
    """Return the command of a compiler, or skip the test."""
    words = COMPILERS[name]
    if shutil.which(words[0]) is None:
        pytest.skip(f"no {words[0]}")
    return words


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["plain", "two memories"])
@pytest.mark.parametrize("name", COMPILERS)
def test_every_file_compiles_without_a_warning(name: str, kind: str, tmp_path: Path) -> None:
    words = find_compiler(name)
    write_network(tmp_path, kind)
    sources = sorted(path.name for path in tmp_path.glob("*.c"))
    assert len(sources) == 2
    for source in sources:
        for bayer in ("0",) if source == "main.c" else ("0", "1"):  # the vectors of main.c are RGB
            command = [*words, *WARNINGS, "-O1", f"-DRANDOM_BAYER={bayer}", "-c", source]
            subprocess.run([*command, "-o", "x.o"], cwd=tmp_path, check=True, capture_output=True)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["plain", "two memories"])
@pytest.mark.parametrize("name", ["gcc", "g++", "clang++"])
def test_a_cpp_program_links_the_c_and_finds_the_same_detections(
    name: str, kind: str, tmp_path: Path
) -> None:
    words = find_compiler(name)
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    network = write_network(tmp_path, kind)
    far = kind == "two memories"
    text = PROGRAM.replace("FAR", "static random_far_t away;\n    " if far else "")
    text = text.replace("STATE", "&net, &away" if far else "&net")
    (tmp_path / "program.cpp").write_text(text)
    for command in (
        [*words, "-DRANDOM_BAYER=0", "-c", "random.c", "-o", "random.o"],
        ["g++", "-DRANDOM_BAYER=0", "program.cpp", "random.o", "-o", "program"],
    ):
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    for image in draw_images(network, 3):
        done = subprocess.run(
            [tmp_path / "program"], input=image.tobytes(), check=True, capture_output=True
        )
        found = np.array([int(word) for word in done.stdout.split()]).reshape(-1, 3).tolist()
        wanted = decode_detections(network, run_network(network, image), 5)
        assert found == [[d.u_q4, d.v_q4, d.depth_mm] for d in wanted]
