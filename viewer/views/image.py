"""Layout ``image``: images of every robot with labels and detections, and maps beside them."""

from dmrl import topics
from dmrl.colours import RGB
from dmrl.viewer import layouts
from dmrl.viewer.drawing import archetypes
from dmrl.viewer.scene import (
    Scene,
    build_camera_panels,
    build_colour_bars,
    build_image_rules,
    build_model_rules,
)
from dmrl.viewer.selection import Selection
from dmrl.viewer.settings import Settings


def scene(selection: Selection, settings: Settings) -> Scene:
    """Build the scene with the images and maps of every robot."""
    scales = archetypes.build_scales(settings.depth_max_m)
    cameras = build_camera_panels(selection, sorted(selection.image_ns), scales)
    blueprint = layouts.build_image_layout(cameras, scales, overlay=settings.overlay)
    shown = Scene(blueprint, [], [], cameras)
    for camera in cameras:
        shown.draws += build_image_rules(camera, shown.sources.setdefault(camera.robot, set()))
        shown.draws += build_model_rules(camera, scales, smooth=settings.overlay)
        shown.stills += build_colour_bars(camera, scales)
        if any(n["robot"] == camera.robot for n in selection.find_names(topics.DETECTIONS)):
            shown.named["detection"] = RGB["detection"]
    return shown
