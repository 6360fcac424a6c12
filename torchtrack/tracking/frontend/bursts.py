"""Bursts: an edge that passes a pixel fires it several times, for the longer the slower the pixel is.

Where the edge is blurred, its events are spread evenly around the moment when it passes. Real pixels go on firing long
after that, above all where it got dark. How far into its burst an event comes tells the two apart.
"""

import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.core.dispatch import accelerable
from torchtrack.core.events import PaddedEvents

# What a pixel fires of one polarity in this time is one burst (µs).
LONGEST_US = 10_000
# Ages (µs) are kept in 16 bits; it does not matter by how much longer ago a burst began.
LONG_AGO_US = 32_000


def no_bursts(streams: int, height: int, width: int, device: torch.device | str | None = None) -> Int[Tensor, "s 2 h w"]:
    """The map of the bursts' ages (µs) before any event."""
    return torch.full((streams, 2, height, width), LONG_AGO_US, dtype=torch.int16, device=device)


def aged(burst_age_us: Int[Tensor, "s 2 h w"], elapsed_us: Int[Tensor, "s"]) -> Int[Tensor, "s 2 h w"]:
    """The bursts' ages some time later (µs); the input is left as it was."""
    elapsed_us = elapsed_us.clamp(max=LONG_AGO_US).to(torch.int16)[:, None, None, None]
    return torch.minimum(burst_age_us, LONG_AGO_US - elapsed_us).add_(elapsed_us)


@accelerable
def update_bursts(
    burst_age_us: Int[Tensor, "s 2 h w"], elapsed_us: Int[Tensor, "s"], events: PaddedEvents, longest_us: int
) -> tuple[Int[Tensor, "s 2 h w"], Int[Tensor, "s e"]]:
    """Ages of the newest burst of every pixel and polarity at a window's end (µs), and how far into its burst each event is (µs).

    What one pixel fires of one polarity within ``longest_us`` is one burst; the next event after that begins another. In a
    window that is longer, bursts that follow the first of a pixel are not told from one another: each event begins its own.

    Args:
        burst_age_us: of the bursts before the window, where it begins; left as it was.
        elapsed_us: how long the window lasts.
        events: of the window.
        longest_us: less than :data:`LONG_AGO_US`.

    Of padding, the second result says nothing.
    """
    _, _, height, width = burst_age_us.shape
    ages = aged(burst_age_us, elapsed_us)
    # In place: out of place, the whole map is copied again.
    flat = ages.flatten(1)
    place = (events.polarity * height + events.y) * width + events.x
    age_us = events.age_us.clamp(max=LONG_AGO_US).to(torch.int16)
    before_us = flat.gather(1, place)
    begins = events.mask & (before_us - age_us >= longest_us)
    # Of several events of a pixel that would begin a burst the oldest does.
    flat.scatter_reduce_(1, place, torch.where(begins, -1, before_us), "amin")
    flat.scatter_reduce_(1, place, torch.where(begins, age_us, -1), "amax")
    into_us = torch.where(begins, flat.gather(1, place), before_us) - age_us
    return ages, torch.where(into_us < longest_us, into_us, 0)
