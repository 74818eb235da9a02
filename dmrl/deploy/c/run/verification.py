"""Verification: compares the C of an export with the reference, bit for bit, on every target."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.bayer_input import demosaic, to_mosaic
from dmrl.deploy.c.harness import MAX_DETECTIONS, HarnessResult, parse_results
from dmrl.deploy.c.network_source import MAX_STACK_BYTES
from dmrl.deploy.c.run.compile_targets import Build, Target
from dmrl.deploy.c.run.toolchain import run_program
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import decode_detections, run_network
from dmrl.errors import ToolError

Image = NDArray[np.uint8]
BAYER_IMAGES = 4
"""Images for builds with raw mosaics: only the input stage of their code differs."""


@dataclass(frozen=True, slots=True)
class BuildResult:
    """Result of one build.

    Parameters
    ----------
    label
        The compiler's settings.
    images
        Number of images.
    mismatches
        Images in which any grid or detection differs from the reference.
    stack_bytes
        Largest stack used; 0 where not measured.
    """

    label: str
    images: int
    mismatches: int
    stack_bytes: int


@dataclass(frozen=True, slots=True)
class TargetResult:
    """Result of a target.

    Parameters
    ----------
    target
        Name of the target.
    builds
        Results of its builds.
    skipped
        Reason why it was not tried; None: it was.
    error
        Error, if any.
    """

    target: str
    builds: list[BuildResult] = field(default_factory=list)
    skipped: str | None = None
    error: str | None = None

    @property
    def mismatches(self) -> int:
        """Images, over all builds, in which something differs."""
        return sum(build.mismatches for build in self.builds)


ExpectedResults = dict[bool, list[tuple[Image, HarnessResult]]]
"""Images and their results: in the network's format (False), and raw mosaics of some (True)."""


def compute_expected(network: IntegerNetwork, images: Sequence[Image]) -> ExpectedResults:
    """Compute the reference results of (height, width, channels) images."""
    raws = [to_mosaic(image) for image in images[:BAYER_IMAGES]]
    seen = [(raw, demosaic(raw, channels=network.channels)) for raw in raws]
    return {
        bayer: [(given, _reference_result(network, image)) for given, image in pairs]
        for bayer, pairs in ((False, [(image, image) for image in images]), (True, seen))
    }


def _reference_result(network: IntegerNetwork, image: Image) -> HarnessResult:
    grids = run_network(network, image)
    return HarnessResult(grids, decode_detections(network, grids, MAX_DETECTIONS), 0)


def verify_target(
    network: IntegerNetwork, folder: Path, target: Target, wanted: ExpectedResults
) -> TargetResult:
    """Verify every build of a target on every image.

    Parameters
    ----------
    network
        Network of the C.
    folder
        The export folder.
    target
        The target.
    wanted
        Images and their expected results.
    """
    result = TargetResult(target.name, skipped=target.skipped or None)
    if result.skipped:
        return result
    for build in target.builds:
        try:
            result.builds.append(_verify_build(network, folder, build, wanted))
        except ToolError as e:
            return TargetResult(target.name, result.builds, error=str(e))
    return result


def _verify_build(
    network: IntegerNetwork, folder: Path, build: Build, wanted: ExpectedResults
) -> BuildResult:
    images, right = zip(*wanted[build.bayer], strict=True)
    with tempfile.TemporaryDirectory(prefix="dmrl-verify-") as place:
        command = build.compile_program(network, folder, Path(place))
        data = b"".join(image.tobytes() for image in images)
        found = parse_results(
            network, run_program(command, f"{build.compiler} {build.label}", data=data)
        )
    if len(found) != len(images):
        raise ToolError(
            f"{build.compiler} {build.label}: answered {len(found)} of {len(images)} images. "
            "Export the model again"
        )
    stack_bytes = max(a.stack_bytes for a in found)
    if stack_bytes > MAX_STACK_BYTES:
        raise ToolError(
            f"{build.compiler} {build.label}: uses {stack_bytes} bytes of stack, the header states "
            f"{MAX_STACK_BYTES}. Give its task more, and report it"
        )
    wrong = sum(not is_same_result(a, b) for a, b in zip(found, right, strict=True))
    return BuildResult(build.label, len(images), wrong, stack_bytes)


def is_same_result(a: HarnessResult, b: HarnessResult) -> bool:
    """Return whether two results agree in every grid and every detection."""
    return a.detections == b.detections and all(
        np.array_equal(a.grids[head], b.grids[head]) for head in b.grids
    )
