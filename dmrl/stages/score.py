"""``dmrl score``: the figures of a submission to the benchmark, as one JSON document."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing


@dataclass(frozen=True, slots=True)
class Settings:
    """Name of the submission.

    Parameters
    ----------
    name
        Name shown on the page.
    """

    name: str = "submission"


def run(
    out: Path,
    settings: Settings,
    scenes: Sequence[Path] = (),
    detected: Sequence[Path] = (),
    followed: Sequence[Path] = (),
    with_uwb: Sequence[Path] = (),
    without_uwb: Sequence[Path] = (),
    network: Path | None = None,
    labels: Path | None = None,
    public: Sequence[Path] = (),
    blind: Sequence[Path] = (),
) -> dict[str, Any]:
    """Score a submission to the benchmark over the sealed seeds.

    The recipe benchmark makes what this reads.

    Parameters
    ----------
    out
        Document to write. Must not exist.
    settings
        See `Settings`.
    scenes
        Recordings with the truth.
    detected
        Outputs of dmrl evaluate for the detections, one a seed.
    followed
        Outputs of dmrl evaluate for the flights, one a seed.
    with_uwb
        Outputs of dmrl evaluate for labels with ranges, one a seed.
    without_uwb
        Outputs of dmrl evaluate for labels without ranges, one a seed.
    network
        Network that was submitted.
    labels
        CSV of positions that was submitted.
    public
        Recordings without the truth, in the order of the scenes.
    blind
        The same without ranges.

    Raises
    ------
    SettingError
        If the submission was made with the truth.
    SourceError
        If the labels are no table of positions.
    OutputError
        If ``out`` exists.
    """
    import json

    from dmrl.atomic_output import atomic_file
    from dmrl.evaluation import benchmark
    from dmrl.learn.pretrained import resolve_model_path
    from dmrl.recording import build_input

    made: dict[str, Any] = {"submission": settings.name, "tasks": {}}
    sources = {"network": network and resolve_model_path(network), "labels": labels}
    for kind, path in sources.items():
        if path is not None:
            benchmark.refuse_sealed(path, scenes)
            made[kind] = {"name": path.name, "sha256": build_input(path).sha256}
    tasks = {
        "detect": detected,
        "follow": followed,
        "label_with_uwb": with_uwb,
        "label_without_uwb": without_uwb,
    }
    for task, outputs in tasks.items():
        if outputs:
            made["tasks"][task] = benchmark.score_documents(task, outputs)
    if labels is not None:
        inputs = {"label_with_uwb": public, "label_without_uwb": blind}
        made["tasks"] |= benchmark.score_labels(labels, scenes, inputs)
    with atomic_file(out) as partial:
        partial.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    return made


command = stage_command(
    run, Closing(lines=lambda made, given: [f"{given.out}: {made['submission']}"])
)
