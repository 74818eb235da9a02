"""``dmrl check``: whether a recording is what it should be."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.recording import check as findings_of
from dmrl.recording import summary
from dmrl.terminal.tables import print_json, print_line


def command(
    recording: Path, /, *, as_json: Annotated[bool, Parameter(name="--json", negative=())] = False
) -> int:
    """Check a recording: schemas, times, gaps, calibration, labels.

    Exit status 1 if there are errors; warnings alone leave it 0.

    Parameters
    ----------
    recording
        A recording.
    as_json
        Print one JSON document instead of lines.
    """
    findings = findings_of(recording)
    errors = sum(f.level == "error" for f in findings)
    if as_json:
        print_json({"recording": recording.name, "findings": [asdict(f) for f in findings]})
    else:
        for finding in findings:
            where = f" {finding.topic}:" if finding.topic else ""
            print_line(f"{finding.level}:{where} {finding.text}")
        found = summary(recording)
        print_line(
            f"{recording}: {found.count} messages on {len(found.topics)} topics, "
            f"{errors} errors, {len(findings) - errors} warnings"
        )
    return 1 if errors else 0
