"""The events of a window as each object sees them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.field_values import field_values
from torchtrack.core.padded import repeated, select_ranked, take_points

GOLDEN_RATIO = 0.6180339887498949


@dataclass(frozen=True)
class WindowEvents:
    """The events of a window as each object's camera saw them, padded.

    Args:
        pixels: ideal pixels.
        age_s: time from the event to the window's end (s).
        polarity: +1 where the pixel got brighter, -1 where darker.
        mask: which entries exist.
        number: of each event among all of its window, where some of them were left out.
    """

    pixels: Float[Tensor, "b e 2"]
    age_s: Float[Tensor, "b e"]
    polarity: Float[Tensor, "b e"]
    mask: Bool[Tensor, "b e"]
    number: Int[Tensor, "b e"] | None = None

    def rows(self) -> "WindowEvents":
        """The events, a row for each object."""
        return self

    def counts(self) -> Int[Tensor, "b"]:
        """How many each object has."""
        return self.mask.sum(-1)

    def of_object(self, number: int) -> "WindowEvents":
        """The events of one object."""
        return self._with(lambda value: value[number : number + 1])

    def of_objects(self, chosen: Int[Tensor, "k"]) -> "WindowEvents":
        """The events of some objects, a row for each."""
        return self._with(lambda value: value[chosen])

    def repeated(self, count: int) -> "WindowEvents":
        """The events of each object as often in turn as makes ``count`` rows."""
        return self._with(lambda value: repeated(value, count))

    def only(self, chosen: Int[Tensor, "b c"], exists: Bool[Tensor, "b c"]) -> "WindowEvents":
        """Some events of each object: their indices, and which of these exist."""
        events = self._with(lambda value: take_points(value, chosen) if value.dim() == 3 else value.gather(1, chosen))
        return replace(events, mask=events.mask & exists, number=chosen if events.number is None else events.number)

    def _with(self, rows: Callable[[Tensor], Tensor]) -> "WindowEvents":
        values = {name: rows(value) for name, value in field_values(self).items() if value is not None}
        return WindowEvents(**values)

    def draw(self, candidates: Bool[Tensor, "b e"], share: Float[Tensor, "b 1"], count: int) -> tuple[Int[Tensor, "b c"], Bool[Tensor, "b c"]]:
        """A share of each row's candidates, spread evenly over them: their indices, at most ``count``, and which of these exist.

        Whether a candidate is drawn hangs on its own number alone.
        """
        number = torch.arange(candidates.shape[1], device=candidates.device) if self.number is None else self.number
        # Multiples of the golden ratio fill the unit interval evenly, whichever stretch of them is taken.
        return select_ranked(candidates & ((number.double() * GOLDEN_RATIO).frac() < share), count)


@dataclass(frozen=True)
class SharedEvents:
    """The events of a window as the objects' cameras saw them, and which of them can have to do with each object: no copies of them.

    Args:
        shared: all of them, one row, stream by stream.
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

    def of_objects(self, chosen: Int[Tensor, "k"]) -> WindowEvents:
        """The events of some objects, a row for each."""
        return replace(self, own=self.own[chosen], count=self.count[chosen]).rows()

    def counts(self) -> Int[Tensor, "b"]:
        """How many each object has."""
        return self.count


# A window's events for each object, laid out one way or the other.
ObjectEvents: TypeAlias = WindowEvents | SharedEvents


def laid_out(events: ObjectEvents) -> tuple[WindowEvents, Int[Tensor, "b e"], Int[Tensor, "b"]]:
    """Events as kernels take them: a row for each object or one for all, places in it of each object's own, and how many these are.

    Without a list of their own, which is empty then, all events of a row are an object's.
    """
    if isinstance(events, SharedEvents):
        return events.shared, events.own, events.count
    # Of what many have in common, one row is enough; but some may be left out for one of them alone.
    rows = events.of_object(0) if events.pixels.stride(0) == events.mask.stride(0) == 0 else events
    return rows, torch.empty(0, 0, dtype=torch.int32), torch.empty(0, dtype=torch.int64)
