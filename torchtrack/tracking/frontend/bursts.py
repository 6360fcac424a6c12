"""Bursts: an edge that passes a pixel fires it several times, for the longer the slower the pixel is.

The first event of a burst tells when the edge came; those after it tell less, above all where it got dark: real pixels go on firing
long after that.
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
def update_bursts(burst_age_us: Int[Tensor, "s 2 h w"], elapsed_us: Int[Tensor, "s"], events: PaddedEvents) -> Int[Tensor, "s 2 h w"]:
    """Ages of the newest burst of every pixel and polarity at a window's end (µs).

    What one pixel fires of one polarity within :data:`LONGEST_US` is one burst; the next event after that begins another. In a
    window that is longer, the first burst that begins in it is the newest.

    Args:
        burst_age_us: of the bursts before the window, where it begins; left as it was.
        elapsed_us: how long the window lasts.
        events: of the window.
    """
    _, _, height, width = burst_age_us.shape
    ages = aged(burst_age_us, elapsed_us)
    # In place: out of place, the whole map is copied again.
    flat = ages.flatten(1)
    place = (events.polarity * height + events.y) * width + events.x
    age_us = events.age_us.clamp(max=LONG_AGO_US).to(torch.int16)
    before_us = flat.gather(1, place)
    begins = events.mask & (before_us - age_us >= LONGEST_US)
    # Of several events of a pixel that would begin a burst the oldest does.
    flat.scatter_reduce_(1, place, torch.where(begins, -1, before_us), "amin")
    flat.scatter_reduce_(1, place, torch.where(begins, age_us, -1), "amax")
    return ages
