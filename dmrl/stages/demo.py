"""``dmrl demo``: the whole pipeline, small, on shipped data."""

from pathlib import Path

from dmrl.terminal.arguments import AsJson


def command(
    *,
    out: Path = Path("demo"),
    as_json: AsJson = False,
) -> None:
    """Run the whole pipeline, small, on pictures that dmrl draws itself.

    Draws pictures of small drones, converts them to a recording, builds a dataset, trains
    the published network on it, lets it look at pictures it has not seen, judges it against
    the truth and shows it; report.html shows it all on one page. The steps are those of the
    recipe demo: dmrl run demo.

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
        print(f"""{page}: open it in a browser; {_find_picture(out)} is a picture of it. Now try:
  dmrl view {out}/predictions.mcap       # the same in rerun, image by image
  dmrl fly fly_in_view flight.mcap && dmrl label flight.mcap labelled.mcap
  dmrl predict dmrl-nano YOUR.mcap found.mcap   # the network that ships, on your own images""")


def _find_picture(out: Path) -> Path:
    """Return the picture that rerun drew, or else the one that matplotlib drew."""
    drawn = out / "picture.png"
    return drawn if drawn.is_file() else out / "evaluation" / "examples.png"
