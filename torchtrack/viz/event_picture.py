"""A picture of the events after a time, with a ruler: where an object is, in pixels, before anything is tracked.

The first events are the brightest, as they are where things were at that time.
"""

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from torchtrack.viz.overlay import enlargement, grey_events

# Events of so long are shown; they fade away in this time.
SHOWN_US, FADING_S = 15_000, 0.006
_TICKS_PX, _LINE, _LETTERS = 50, (72, 72, 72), (150, 200, 150)
_NEVER_US = -(1 << 40)


def soonest_event(pixels: Int[np.ndarray, "e 2"], t_us: Int[np.ndarray, "e"], at_us: int, size: tuple[int, int]) -> Int[np.ndarray, "h w"]:
    """A time surface that looks ahead: as long before ``at_us`` as the soonest event of a pixel comes after it.

    Args:
        pixels: (u, v) of events after ``at_us``; those outside the image are left out.
        t_us: their times.
        at_us: the time that is shown.
        size: width and height of the image (px).
    """
    width, height = size
    surface = np.full((height, width), _NEVER_US, dtype=np.int64)
    u, v = pixels.T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    np.maximum.at(surface, (v[inside], u[inside]), 2 * at_us - t_us[inside])
    return surface


def draw_events(surface: Int[np.ndarray, "h w"], at_us: int) -> UInt8[np.ndarray, "hs ws 3"]:
    """The picture (BGR) of a surface of :func:`soonest_event`, enlarged as an overlay is, with a ruler."""
    scale = enlargement(surface.shape[1])
    return with_ruler(grey_events(surface, at_us, FADING_S, scale), scale)


def with_ruler(image: UInt8[np.ndarray, "hs ws 3"], scale: int) -> UInt8[np.ndarray, "hs ws 3"]:
    """A picture, enlarged by ``scale``, with lines every 50 sensor pixels, and their numbers at its right and lower border."""
    height, width = image.shape[:2]
    marks: Float[np.ndarray, "n"] = np.arange(_TICKS_PX, max(width, height) / scale, _TICKS_PX)
    lined = image.copy()
    for mark in marks:
        at = round(scale * (mark + 0.5) - 0.5)
        cv2.line(lined, (at, 0), (at, height - 1), _LINE, 1)
        cv2.line(lined, (0, at), (width - 1, at), _LINE, 1)
        _write(lined, f"{mark:.0f}", (at + 3, height - 5))
        _write(lined, f"{mark:.0f}", (width - 36, at - 3))
    # What is drawn stays on top of the lines.
    return np.maximum(lined, image)


def _write(image: UInt8[np.ndarray, "hs ws 3"], text: str, at: tuple[int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, _LETTERS, 1, cv2.LINE_AA)
