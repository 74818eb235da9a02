"""``dmrl export``: a network as files that run elsewhere: ONNX, and C for a microcontroller."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

from dmrl.atomic_output import atomic_folder, refuse_existing
from dmrl.learn.pretrained import resolve_model_path
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import Model
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.progress import say

if TYPE_CHECKING:
    from dmrl.deploy.c.run.measure import StateMemory
    from dmrl.deploy.export_folder import Written


@dataclass(frozen=True, slots=True)
class Settings:
    """Form of the C.

    Parameters
    ----------
    bayer
        The C takes raw colour mosaics, as the AI-deck's camera gives them, unless it is compiled
        otherwise.
    decoded
        Write ONNX files that decode as well: pixels, metres and confidences out, in place of maps.
    l1_kb
        The C works in a near memory of so many kilobytes, 8 of which are left for stacks, such as
        the 64 of a GAP8's L1: rings that do not fit lie in a far one, and rows are copied.
    """

    bayer: bool = False
    decoded: bool = False
    l1_kb: Annotated[int | None, Parameter(validator=validators.Number(gte=9))] = None


def run(model: Model, out: Path, settings: Settings) -> "list[Written]":
    """Write a network as ONNX and as C.

    Parameters
    ----------
    model
        What dmrl quantize wrote. A run folder, a .safetensors or a Keras .h5 becomes float ONNX
        alone.
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    ModelError
        If the model cannot be used, or has a layer that cannot be carried.
    MissingExtra
        If torch or onnx is not installed.
    OutputError
        If ``out`` exists.
    SettingError
        If the near memory is too small.
    """
    from dmrl.deploy.c.pilot_code import write_pilot
    from dmrl.deploy.export_folder import list_files, refuse_export, write_decoded, write_export
    from dmrl.deploy.usage import write_usage
    from dmrl.flight.onboard_input import DETECTIONS_MAX
    from dmrl.flight.onboard_pilot import CONSTANTS
    from dmrl.geometry.frames import AIDECK_PINHOLE
    from dmrl.recording import build_provenance

    refuse_existing(out)
    model = resolve_model_path(model)
    refuse_export(model)
    made = build_provenance("export", settings, (model,), libraries=("torch", "onnx", "numpy"))
    with atomic_folder(out) as folder:
        form = {key: value for key, value in asdict(settings).items() if key != "decoded"}
        quantized = write_export(model, folder, **form)
        if settings.decoded:
            write_decoded(folder)
        write_usage(folder)
        if quantized:
            write_pilot(folder, AIDECK_PINHOLE, CONSTANTS, DETECTIONS_MAX)
        made.write(folder)
    if not quantized:
        say(f"no int8 and no C: {model} is float. For those: dmrl quantize {model} DATASET OUT")
    return list_files(out)


def _measure_memory(written: "list[Written]", out: Path) -> "StateMemory | None":
    """Return the memory that the C takes; None: there is no C."""
    from dmrl.deploy.c.run.measure import parse_state_memory
    from dmrl.deploy.int8.store import INTEGER_NAME, load_network

    if not any(file.name == INTEGER_NAME for file in written):
        return None
    return parse_state_memory(load_network(out), out)


def _document(written: "list[Written]", given: Given) -> dict[str, Any]:
    files = {"folder": str(given.out), "files": {file.name: file.size_bytes for file in written}}
    memory = _measure_memory(written, given.out)
    return {**files, **asdict(memory), "fits_gap8_l1": memory.fits_l1} if memory else files


def _lines(written: "list[Written]", given: Given) -> Iterator[str]:
    from dmrl.deploy.c import MAX_L1_STATE_BYTES
    from dmrl.deploy.c.pilot_code import PILOT_BYTES

    memory = _measure_memory(written, given.out)
    if memory is None:
        return
    fit = "fits" if memory.fits_l1 else "does not fit"
    other = "" if memory.fits_l1 else "; --l1-kb 64 makes two memories of it"
    yield (
        f"{memory.state_bytes:,} bytes of RAM, which {fit} a GAP8's L1: {MAX_L1_STATE_BYTES:,} "
        "beside "
        f"stacks{other}"
    )
    yield f"{PILOT_BYTES:,} bytes more for the state of pilot.c, which flies by its detections"
    if memory.far_bytes:
        yield (
            f"{memory.far_bytes:,} bytes more in a far memory; {memory.traffic_bytes:,} bytes are "
            "copied an image"
        )
    yield f"prove the C with: dmrl verify {given.out}"


command = stage_command(
    run,
    Closing(
        columns=("file", "bytes", "what it is"),
        rows=lambda written, _: [(file.name, file.size_bytes, file.what) for file in written],
        lines=_lines,
        document=_document,
    ),
)
