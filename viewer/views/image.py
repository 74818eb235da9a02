"""Layout ``image``: images of every robot with labels and detections, and maps beside them."""

from dmrl import topics
from dmrl.colours import RGB
from dmrl.viewer import layouts
from dmrl.viewer.drawing import archetypes
from dmrl.viewer.scene import Scene, bars, eyes_of, model_draws, picture_draws
from dmrl.viewer.selection import Selection
from dmrl.viewer.settings import Settings


def scene(selection: Selection, settings: Settings) -> Scene:
    """Build the scene with the images and maps of every robot."""
    scales = archetypes.scales(settings.depth_max_m)
    eyes = eyes_of(selection, sorted(selection.image_ns), scales)
    blueprint = layouts.image(eyes, scales, overlay=settings.overlay)
    shown = Scene(blueprint, [], [], eyes)
    for eye in eyes:
        shown.draws += picture_draws(eye, shown.sources.setdefault(eye.robot, set()))
        shown.draws += model_draws(eye, scales, smooth=settings.overlay)
        shown.stills += bars(eye, scales)
        if any(n["robot"] == eye.robot for n in selection.found(topics.DETECTIONS)):
            shown.named["detection"] = RGB["detection"]
    return shown
