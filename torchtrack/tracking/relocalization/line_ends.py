"""Whether the lines that explain straight contours end where these do.

A straight edge of what hides an object explains any straight contour that is laid along it, and all of a pose whose contours are
nothing but its two edges. What gives it away is that its events go on, in line, where the contour has come to its end.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.neighbours import largest_around
from torchtrack.core.padded import select_ranked, take_points
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization.event_image import Places, event_density, look_up

# Contour points that are looked at, at most.
_POINTS = 256
# How far a contour must have come straight to its end, and how far beyond that events are looked for (px).
_BEFORE_PX, _BEYOND_PX = (8.0, 16.0, 24.0), (8.0, 14.0)
# A contour goes on where it has a point this near; it has come to its end where it has none this near (px).
_ON_PX, _OFF_PX = 2.0, 4.0
# Where there are no points (px).
_NOWHERE_PX = 1e5
# So many ends that hold are taken for granted: some are there by chance.
_GRANTED = 3.0


def running_on(contours: Contours, number: Int[Tensor, "n"], places: Places, image_size: tuple[int, int]) -> Float[Tensor, "n"]:
    """Of the ends of straight contours with events on them, the ratio beyond which the events go on; small where there are few ends.

    Args:
        contours: of an object at each of some poses, and the ``number`` of its row of ``places``.
        places: pixels of the events at the window's end, and which of them exist.
        image_size: height and width (px).
    """
    # Larger than zero where there is an event two pixels away or nearer.
    fired = largest_around(event_density(*places, image_size), 1)
    chosen, exists = select_ranked(contours.mask, _POINTS)
    pixels, normals = take_points(contours.pixels, chosen), take_points(contours.normals, chosen)
    along = torch.stack([-normals[..., 1], normals[..., 0]], -1)
    own = torch.where(exists[..., None], pixels, _NOWHERE_PX)
    seen = exists & (look_up(fired, number, pixels) > 0)
    ends, running = torch.zeros_like(pixels[:, 0, 0]), torch.zeros_like(pixels[:, 0, 0])
    for forward in (along, -along):
        is_end, runs_on = seen, seen
        for step_px in _BEFORE_PX:
            before = pixels - step_px * forward
            is_end = _with_point(own, before, _ON_PX, is_end & (look_up(fired, number, before) > 0))
        for step_px in _BEYOND_PX:
            beyond = pixels + step_px * forward
            is_end = is_end & ~_with_point(own, beyond, _OFF_PX, is_end)
            runs_on = runs_on & (look_up(fired, number, beyond) > 0)
        ends, running = ends + is_end.sum(-1), running + (is_end & runs_on).sum(-1)
    return running / (ends + _GRANTED)


def _with_point(own: Float[Tensor, "n m 2"], places: Float[Tensor, "n k 2"], distance_px: float, among: Bool[Tensor, "n k"]) -> Bool[Tensor, "n k"]:
    """Which places, ``among`` some, have any of their pose's contour points no farther away than this."""
    if not host_sync.read_at_once(among):
        return among & (torch.cdist(places, own, compute_mode="donot_use_mm_for_euclid_dist").amin(-1) <= distance_px)
    # Few are left after the first tests: the distances of these alone are looked at.
    pose, place = among.nonzero().unbind(1)
    least_px2 = (own[pose] - places[pose, place][:, None]).square().sum(-1).amin(-1)
    return among.index_put((pose, place), least_px2 <= distance_px**2)
