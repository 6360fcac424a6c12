"""Events that objects explain which are seen well: no evidence for others that are not.

The contours of an object that is lost find the edges of those beside it, as any contours find any edges, and what is laid along them
explains much. But what an object that is seen well explains needs no other explanation (Pearl, "Probabilistic Reasoning in Intelligent
Systems", 1988: explaining away). Objects that are seen well themselves keep all their events: where two touch, the edge is of both.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.core.neighbours import largest_around
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction

# An object that was not seen well for so long has no claim to what others explain (s).
UNSEEN_FROM_S = 0.025
# Events so near to where a contour passes are its own (px).
CLAIMED_WITHIN_PX = 2
# A contour is looked at in so many places of its way through a window.
PLACES = 3


@accelerable
def claimed_pixels(
    prediction: Prediction, contours: Contours, is_seen_well: Bool[Tensor, "b"], window_s: Float[Tensor, "b"]
) -> Bool[Tensor, "s h w"]:
    """Pixels that contours of objects which are seen well pass in a window, and those beside them.

    Args:
        prediction: of the objects, with ``contours`` there.
        window_s: how long the window lasts, for each object.
    """
    streams, height, width = prediction.objects.image_shape
    back_s = window_s[:, None] * torch.linspace(0, 1, PLACES, dtype=window_s.dtype, device=window_s.device)
    passed = contours.pixels[:, None] - back_s[..., None, None] * prediction.contour_velocity(contours)[:, None]
    u, v, is_on_sensor = _on_sensor(passed, width, height)
    exists = is_on_sensor & (is_seen_well[:, None] & contours.mask)[:, None]
    # What does not exist is put behind the last sensor.
    stream = torch.where(exists, prediction.objects.stream_index[:, None, None], streams)
    passed_by = torch.zeros(streams + 1, height, width, dtype=torch.bool, device=window_s.device)
    # A number would be a tensor on the CPU, which a CUDA graph cannot wait for.
    passed_by.index_put_((stream, v, u), torch.ones_like(passed_by[0, 0, 0]))
    return largest_around(passed_by[:-1].float(), CLAIMED_WITHIN_PX) > 0


@accelerable
def without_claimed(
    events: ObjectEvents, claimed: Bool[Tensor, "s h w"], stream_index: Int[Tensor, "b"], concerned: Bool[Tensor, "b"]
) -> ObjectEvents:
    """The events without those in ``claimed`` pixels, of the ``concerned`` objects alone."""
    rows = events.rows()
    u, v, is_on_sensor = _on_sensor(rows.pixels, claimed.shape[2], claimed.shape[1])
    return replace(rows, mask=rows.mask & ~(concerned[:, None] & is_on_sensor & claimed[stream_index[:, None], v, u]))


def _on_sensor(pixels: Float[Tensor, "*n 2"], width: int, height: int) -> tuple[Int[Tensor, "*n"], Int[Tensor, "*n"], Bool[Tensor, "*n"]]:
    """Columns and rows of the image, and which of them are in it; of others, its first."""
    limit = constant((width - 1, height - 1), pixels.dtype, pixels.device)
    nearest = pixels.round()
    # Written so that what is not a number is outside.
    inside = ((nearest >= 0) & (nearest <= limit)).all(-1)
    u, v = torch.where(inside[..., None], nearest, 0).long().unbind(-1)
    return u, v, inside
