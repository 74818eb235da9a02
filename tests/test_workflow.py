"""The GitHub workflow runs .ci/run and uploads the files that it builds."""

import os
import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
STEPS = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["run"]["steps"]


def test_workflow_runs_the_ci_script() -> None:
    assert [step["run"] for step in STEPS if "run" in step][-1] == ".ci/run"
    assert os.access(ROOT / ".ci/run", os.X_OK)
    targets = set(re.findall(r"^make ([a-z-]+)", (ROOT / ".ci/run").read_text(), re.MULTILINE))
    assert {"check", "test", "test-heavy", "site", "wheels"} <= targets


def test_the_workflow_keeps_wheel_and_pages() -> None:
    kept = {step["with"]["path"] for step in STEPS if "upload" in step.get("uses", "")}
    pages = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["site_dir"]
    assert kept == {"build/dist", pages}
    assert 'cp -r "$place/dist" build/dist' in (ROOT / ".ci/wheels").read_text()
