"""How far events lie from the contours that should have caused them: a measure that needs no ground truth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

# Events further from every contour point say nothing about an object.
GATE_PX = 10.0


@dataclass(frozen=True)
class Alignment:
    """Events and the contours of one object.

    Args:
        median_px: median distance of the events near the contours, normal to them; NaN where there is none.
        share_near: share of all events that are near the contours.
    """

    median_px: float
    share_near: float


def alignment(events: Float[ndarray, "e 2"], contour: Float[ndarray, "m 2"], normals: Float[ndarray, "m 2"]) -> Alignment:
    """Alignment of events with contour points, all in ideal pixels; an event counts towards its nearest point."""
    if len(events) == 0 or len(contour) == 0:
        return Alignment(float("nan"), 0.0)
    distance, nearest = cKDTree(contour).query(events, distance_upper_bound=GATE_PX)
    near = np.isfinite(distance)
    if not near.any():
        return Alignment(float("nan"), 0.0)
    offsets = events[near] - contour[nearest[near]]
    normal_px = np.abs((offsets * normals[nearest[near]]).sum(1))
    return Alignment(float(np.median(normal_px)), float(near.mean()))
