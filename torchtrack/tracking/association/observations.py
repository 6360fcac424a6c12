"""What is matched with contours: recent events near them, and corners where there are any."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.core.dispatch import accelerable
from torchtrack.core.field_values import field_values
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.core.padded import running_count, take_points
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.window_events import GOLDEN_RATIO, ObjectEvents

# Lots are drawn for a little less than what there is room for, as their number varies.
FILL = 0.95


@dataclass(frozen=True)
class Observations:
    """What was seen, padded: corners and events.

    Args:
        pixels: ideal pixels at the time of the event.
        age_s: time from the event to the window's end (s).
        polarity: +1 where the pixel got brighter, -1 where darker, 0 where unknown.
        mask: which entries exist.
        flow: velocity (px/s); zero where there is none.
        has_flow: where the flow is known.
        trust: how far each entry is to be believed, 0 to 1, where something was there to tell it.
    """

    pixels: Float[Tensor, "b n 2"]
    age_s: Float[Tensor, "b n"]
    polarity: Float[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    flow: Float[Tensor, "b n 2"]
    has_flow: Bool[Tensor, "b n"]
    trust: Float[Tensor, "b n"] | None = None


def corner_observations(corners: Corners) -> Observations:
    """The corners as observations."""
    return Observations(corners.pixels, corners.age_s, corners.polarity, corners.mask, corners.flow, corners.has_flow)


@accelerable
def select_events(events: ObjectEvents, index: ContourIndex, objects: MovingObjects, count: int, corners: Observations | None = None) -> Observations:
    """Events near an object's contours once moved to the window's end: at most ``count``, spread evenly in time.

    Which of them are taken hangs on each event's own number, not on how many come before it: a pose that is a little
    different takes almost the same events.

    Args:
        corners: stay in their places. Of the events, there are then in the places that they leave as many as make up ``count``, where
            corners are fewer.
    """
    events = events.rows()
    pixels, mask = events.pixels, events.mask
    near = mask & (index.look_up(torch.addcmul(pixels, objects.plane_velocity(pixels), events.age_s[..., None])) >= 0)
    total = near.sum(-1, keepdim=True)
    share = torch.where(total > count, FILL * count / total, 1.0)
    chosen, exists = events.draw(near, share, count)
    rows = [pixels.transpose(1, 2), events.age_s[:, None], events.polarity[:, None]]
    taken = event_observations(take_points(torch.cat(rows, 1).transpose(1, 2), chosen), exists)
    return taken if corners is None or corners.mask.shape[1] == 0 else _filled_up(corners, taken, count)


def event_observations(values: Float[Tensor, "b c 4"], exists: Bool[Tensor, "b c"]) -> Observations:
    """Observations of events: columns of pixels, ages and polarities."""
    flow = torch.zeros_like(values[..., :2])
    return Observations(values[..., :2], values[..., 2], values[..., 3], exists, flow, torch.zeros_like(exists))


def join(first: Observations, second: Observations) -> Observations:
    """Observations of both, for each object; none has been judged yet."""
    names = [name for name in field_values(first) if name != "trust"]
    return Observations(*(_one_after_the_other(getattr(first, name), getattr(second, name)) for name in names))


def _filled_up(corners: Observations, events: Observations, count: int) -> Observations:
    """Corners, and in the places that they leave as many events, spread evenly over all that are given, as make up ``count``."""
    own, device = corners.mask.shape[1], events.mask.device
    places = max(count, own)
    room, given = count - corners.mask.sum(-1, keepdim=True), events.mask.sum(-1, keepdim=True)
    lot = (torch.arange(events.mask.shape[1], dtype=torch.float64, device=device) * GOLDEN_RATIO).frac()
    kept = running_count(events.mask & (lot < room.double() / given.clamp(min=1)))
    is_corner = pad(corners.mask, (0, places - own))
    rank = (~is_corner).cumsum(-1)
    chosen = torch.searchsorted(kept, rank).clamp(max=events.mask.shape[1] - 1)
    index, both = torch.where(is_corner, torch.arange(places, device=device), own + chosen), join(corners, events)
    values = {
        name: take_points(value, index) if value.dim() == 3 else value.gather(1, index)
        for name, value in field_values(both).items()
        if name != "trust"
    }
    return Observations(**values | {"mask": is_corner | (rank <= kept[:, -1:])})


def _one_after_the_other(first: Tensor, second: Tensor) -> Tensor:
    """Both, along the second dimension; in memory, coordinates are rows."""
    if first.dim() == 2:
        return torch.cat([first, second], 1)
    return torch.cat([first.transpose(1, 2), second.transpose(1, 2)], 2).transpose(1, 2)
