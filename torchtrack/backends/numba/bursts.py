"""Bursts of events at pixels: :mod:`torchtrack.tracking.frontend.bursts`, event by event."""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.backends.numba.arrays import PaddedArrays, as_arrays, padded_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.core.dispatch import accelerates
from torchtrack.core.events import PaddedEvents
from torchtrack.tracking.frontend import bursts
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, LONGEST_US


@kernel()
def update_bursts(events: PaddedArrays, elapsed_us: Array, longest_us: int, long_ago_us: int, before: Array, ages: Array) -> None:
    """Bring a map of bursts up to a window's end.

    Args:
        elapsed_us: ``[s]``.
        before: ``[s, 2, h, w]``, where the window began.
        ages: at its end; filled.
    """
    (x, y, age_us, polarity, mask), height, width = events, np.uint64(before.shape[2]), np.uint64(before.shape[3])
    for s in range(len(mask)):
        elapsed, aged = elapsed_us[s], ages[s].ravel()
        age_all(before[s].ravel(), np.int16(elapsed), np.int16(long_ago_us - elapsed), aged)
        for i in range(mask.shape[1]):
            place = (np.uint64(polarity[s, i]) * height + np.uint64(y[s, i])) * width + np.uint64(x[s, i])
            fire(aged, place, min(age_us[s, i], long_ago_us), mask[s, i], elapsed, longest_us)


@kernel()
def age_all(before: Array, elapsed: int, most: int, ages: Array) -> None:
    """All ages some time later: :func:`torchtrack.tracking.frontend.bursts.aged`."""
    for i in range(len(before)):
        ages[i] = min(before[i], most) + elapsed


@kernel()
def fire(ages: Array, place: int, age: int, exists: bool, elapsed_us: int, longest_us: int) -> None:
    """Bring a map of bursts up with one event, which may begin one; ``ages`` are those of the map, all at the window's end.

    Events come in the order of their times: the first of a pixel that begins a burst in the window is the oldest, and those after
    it begin none. What is younger than the window began in it.
    """
    began = np.int64(ages[place])
    # Written always, in the place of a branch of which a processor would guess many wrong: twice as fast.
    ages[place] = np.int16(age if exists and began - age >= longest_us and began >= elapsed_us else began)


def _ages_tell(burst_age_us: Tensor, elapsed_us: Tensor, events: PaddedEvents) -> bool:
    """Whether ages of bursts tell what began in the window: not in longer ones."""
    return bool((elapsed_us < LONG_AGO_US).all())


@accelerates(bursts.update_bursts, supports=_ages_tell)
def update_bursts_numba(burst_age_us: Int[Tensor, "s 2 h w"], elapsed_us: Int[Tensor, "s"], events: PaddedEvents) -> Int[Tensor, "s 2 h w"]:
    """One event after the other."""
    ages = torch.empty(burst_age_us.shape, dtype=torch.int16)
    update_bursts(padded_arrays(events), elapsed_us.numpy(), LONGEST_US, LONG_AGO_US, *as_arrays(burst_age_us, ages))
    return ages
