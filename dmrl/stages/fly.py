"""``dmrl fly``: a simulated flight of several robots, as a recording."""

from pathlib import Path

from dmrl.guards.lazy_names import import_lazily
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.simulation.settings import FlyFlags as Flags
from dmrl.terminal.arguments import AsJson, Flat, On, Recipe
from dmrl.terminal.closing import Closing, Given

FLIGHT = "dmrl.simulation.flight_recording"
__getattr__ = import_lazily(
    __name__, {"run": f"{FLIGHT}:record_flight", "Settings": f"{FLIGHT}:FlySettings"}
)
NO_FLAGS = Flags()
CLOSING = Closing(columns=("topics", "messages"), path_key="recording", result_key="messages")


def command(
    recipe: Recipe,
    out: Path,
    /,
    *,
    flags: Flat[Flags] = NO_FLAGS,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Simulate a flight of robots that measure themselves and each other.

    Parameters
    ----------
    recipe
        A TOML file, or the name of a shipped recipe, such as fly_in_view.
    out
        Recording to write. Must not exist.
    """
    from dmrl import recipe as recipes
    from dmrl.simulation.flight_recording import FlySettings, record_flight

    settings = recipes.load(recipe, "fly", FlySettings, flags)
    counts = (
        record_flight(out, settings) if on is None else run_on_cluster(on, "fly", out, {}, settings)
    )
    CLOSING.print(counts or {}, Given(out=out), as_json=as_json)
