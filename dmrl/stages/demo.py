"""``dmrl demo``: the whole pipeline, small, on shipped data."""

import sys
from pathlib import Path

from dmrl.terminal.arguments import AsJson


def command(*, out: Path = Path("demo"), as_json: AsJson = False) -> None:
    """Run the whole pipeline, small, on a flight that ships and on pictures it draws.

    First, the network that ships finds and tracks a drone in a rendered flight. Then dmrl draws
    pictures of small drones, builds a dataset, trains the published network on it and evaluates
    it on other pictures. report.html shows all results on one page. The recipe demo has the same
    steps: dmrl run demo.

    Parameters
    ----------
    out
        Folder for every output.
    """
    from dmrl.evaluation.pipeline_summary import print_report
    from dmrl.html_report import write_html_report
    from dmrl.pipeline import recipe_run as pipeline

    print_report(pipeline.run("demo", out), as_json=as_json)
    page = write_html_report(out)
    if not as_json:
        print(f"{page}: open it in a browser. Now try:\n{suggest_commands(out, sys.argv[0])}")


def suggest_commands(out: Path, program: str) -> str:
    """Return commands to try next, as the shell that ran ``program`` finds them.

    ``make demo`` runs dmrl by its path, since the environment is not active.
    """
    activate = Path(program).with_name("activate")
    lines = [f"source {activate}"] if "/" in program and activate.is_file() else []
    lines += [
        f"dmrl view {out}/flight_tracks.mcap     # the flight in rerun: images, detections, tracks",
        "dmrl fly fly_in_view flight.mcap --camera && dmrl label flight.mcap labelled.mcap",
        "dmrl convert PHOTOS photos.mcap --width-px 640 --height-px 480    # your own pictures",
        "dmrl predict dmrl-nano photos.mcap found.mcap && dmrl view found.mcap",
    ]
    return "\n".join(f"  {line}" for line in lines)
