"""Pictures of what was tracked."""

from torchtrack.viz.overlay import OverlayObject, draw_overlay, overlay_objects
from torchtrack.viz.video import OverlayWriter, save_still

__all__ = ["OverlayObject", "OverlayWriter", "draw_overlay", "overlay_objects", "save_still"]
