"""What is matched with contours: recent events near them, and corners where there are any."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core import dispatch
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.core.padded import select_ranked, take_points
from torchtrack.corners import Corners
from torchtrack.kernels.arrays import as_arrays
from torchtrack.tracking.contours.index import ContourIndex

_GOLDEN_RATIO = 0.6180339887498949
# Lots are drawn for a little less than what there is room for, as their number varies.
_FILL = 0.95


@dataclass(frozen=True)
class Observations:
    """What was seen, padded: corners and events.

    Args:
        pixels: ideal pixels at the time of the event.
        age_s: time from the event to the window's end (s).
        into_burst_s: time from the first event of its burst to the event (s); zero where there is none.
        polarity: +1 where the pixel got brighter, -1 where darker, 0 where unknown.
        mask: which entries exist.
        flow: velocity (px/s); zero where there is none.
        has_flow: where the flow is known.
        trust: how far each entry is to be believed, 0 to 1, where something was there to tell it.
    """

    pixels: Float[Tensor, "b n 2"]
    age_s: Float[Tensor, "b n"]
    into_burst_s: Float[Tensor, "b n"]
    polarity: Float[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    flow: Float[Tensor, "b n 2"]
    has_flow: Bool[Tensor, "b n"]
    trust: Float[Tensor, "b n"] | None = None


@dataclass(frozen=True)
class WindowEvents:
    """The events of a window as each object's camera saw them, padded.

    Args:
        pixels: ideal pixels.
        age_s: time from the event to the window's end (s).
        into_burst_s: time from the first event of its burst to the event (s).
        polarity: +1 where the pixel got brighter, -1 where darker.
        mask: which entries exist.
        number: of each event among all of its window, where some of them were left out.
    """

    pixels: Float[Tensor, "b e 2"]
    age_s: Float[Tensor, "b e"]
    into_burst_s: Float[Tensor, "b e"]
    polarity: Float[Tensor, "b e"]
    mask: Bool[Tensor, "b e"]
    number: Int[Tensor, "b e"] | None = None

    def rows(self) -> "WindowEvents":
        """The events, a row for each object."""
        return self

    def counts(self) -> Int[Tensor, "b"]:
        """How many each object has."""
        return self.mask.sum(-1)

    def of(self, number: int) -> "WindowEvents":
        """The events of one object."""
        return self._with(lambda value: value[number : number + 1])

    def repeated(self, count: int) -> "WindowEvents":
        """The events of one object, for ``count`` of its kind."""
        return self._with(lambda value: value.expand(count, *value.shape[1:]))

    def only(self, chosen: Int[Tensor, "b c"], exists: Bool[Tensor, "b c"]) -> "WindowEvents":
        """Some events of each object: their indices, and which of these exist."""
        events = self._with(lambda value: take_points(value, chosen) if value.dim() == 3 else value.gather(1, chosen))
        return replace(events, mask=events.mask & exists, number=chosen if events.number is None else events.number)

    def _with(self, rows: Callable[[Tensor], Tensor]) -> "WindowEvents":
        values = {name: rows(value) for name, value in vars(self).items() if value is not None}
        return WindowEvents(**values)

    def draw(self, candidates: Bool[Tensor, "b e"], share: Float[Tensor, "b 1"], count: int) -> tuple[Int[Tensor, "b c"], Bool[Tensor, "b c"]]:
        """A share of each row's candidates, spread evenly over them: their indices, at most ``count``, and which of these exist.

        Whether a candidate is drawn hangs on its own number alone.
        """
        number = torch.arange(candidates.shape[1], device=candidates.device) if self.number is None else self.number
        # Multiples of the golden ratio fill the unit interval evenly, whichever stretch of them is taken.
        return select_ranked(candidates & ((number.double() * _GOLDEN_RATIO).frac() < share), count)


@dataclass(frozen=True)
class SharedEvents:
    """The events of a window that several objects' camera saw, and which of them can have to do with each: no copies of them.

    Args:
        shared: all of them, one row.
        own: places in it of those of each object; as many as ``count`` says.
    """

    shared: WindowEvents
    own: Int[Tensor, "b e"]
    count: Int[Tensor, "b"]

    def rows(self) -> WindowEvents:
        """The events, a row for each object."""
        exists = torch.arange(max(int(self.count.max()), 1)) < self.count[:, None]
        own = torch.where(exists, self.own[:, : exists.shape[1]], 0).long()
        return self.shared.repeated(len(own)).only(own, exists)

    def counts(self) -> Int[Tensor, "b"]:
        """How many each object has."""
        return self.count

    def of(self, number: int) -> WindowEvents:
        """The events of one object."""
        count = max(int(self.count[number]), 1)
        exists = torch.arange(count)[None] < self.count[number]
        return self.shared.only(torch.where(exists, self.own[number : number + 1, :count], 0).long(), exists)


# A window's events for each object, laid out one way or the other.
ObjectEvents: TypeAlias = WindowEvents | SharedEvents


def corner_observations(corners: Corners) -> Observations:
    """The corners as observations; their polarity is not known."""
    unknown = torch.zeros_like(corners.age_s)
    return Observations(corners.pixels, corners.age_s, unknown, unknown, corners.mask, corners.flow, corners.has_flow)


def select_events(events: ObjectEvents, index: ContourIndex, objects: MovingObjects, count: int) -> Observations:
    """Events near an object's contours once moved to the window's end: at most ``count``, spread evenly in time.

    Which of them are taken hangs on each event's own number, not on how many come before it: a pose that is a little
    different takes almost the same events.
    """
    if dispatch.apply_to(objects.velocity):
        values, exists = _selected_by_kernel(events, index, objects, count)
    else:
        events = events.rows()
        pixels, mask = events.pixels, events.mask
        near = mask & (index.look_up(torch.addcmul(pixels, objects.plane_velocity(pixels), events.age_s[..., None])) >= 0)
        total = near.sum(-1, keepdim=True)
        share = torch.where(total > count, _FILL * count / total, 1.0)
        chosen, exists = events.draw(near, share, count)
        rows = [pixels.transpose(1, 2), events.age_s[:, None], events.into_burst_s[:, None], events.polarity[:, None]]
        values = take_points(torch.cat(rows, 1).transpose(1, 2), chosen)
    flow = torch.zeros_like(values[..., :2])
    return Observations(values[..., :2], values[..., 2], values[..., 3], values[..., 4], exists, flow, torch.zeros_like(exists))


def laid_out(events: ObjectEvents) -> tuple[WindowEvents, Int[Tensor, "b e"], Int[Tensor, "b"]]:
    """Events as kernels take them: a row for each object or one for all, places in it of each object's own, and how many these are.

    Without a list of their own, which is empty then, all events of a row are an object's.
    """
    if isinstance(events, SharedEvents):
        return events.shared, events.own, events.count
    # Of what many have in common, one row is enough.
    rows = events.of(0) if events.pixels.stride(0) == 0 else events
    return rows, torch.empty(0, 0, dtype=torch.int32), torch.empty(0, dtype=torch.int64)


def _selected_by_kernel(
    events: ObjectEvents, index: ContourIndex, objects: MovingObjects, count: int
) -> tuple[Float[Tensor, "b c 5"], Bool[Tensor, "b c"]]:
    """What is told of the events that :func:`select_events` takes, and which there are, event by event."""
    # Not at the top: Numba is an extra.
    from torchtrack.kernels.selection import select

    rows, own, counts = laid_out(events)
    number = torch.arange(rows.mask.shape[1]).expand(len(rows.mask), -1) if rows.number is None else rows.number
    batch = len(objects.velocity)
    chosen, exists = rows.pixels.new_empty(batch, 5, count), torch.empty(batch, count, dtype=torch.bool)
    seen = as_arrays(*rows.pixels.unbind(-1), rows.age_s, rows.into_burst_s, rows.polarity, rows.mask, number, own, counts)
    moving = as_arrays(objects.velocity, objects.centre_cam, objects.intrinsics, index.nearest, index.first)
    select(*seen, *moving, index.cells, _FILL, _GOLDEN_RATIO, chosen.numpy(), exists.numpy())
    return chosen.transpose(1, 2), exists


def join(first: Observations, second: Observations) -> Observations:
    """Observations of both, for each object; none has been judged yet."""
    if first.mask.shape[1] == 0:
        return second
    names = [name for name in vars(first) if name != "trust"]
    return Observations(*(_one_after_the_other(getattr(first, name), getattr(second, name)) for name in names))


def _one_after_the_other(first: Tensor, second: Tensor) -> Tensor:
    """Both, along the second dimension; in memory, coordinates are rows."""
    if first.dim() == 2:
        return torch.cat([first, second], 1)
    return torch.cat([first.transpose(1, 2), second.transpose(1, 2)], 2).transpose(1, 2)
