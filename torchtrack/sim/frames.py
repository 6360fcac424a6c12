"""When to render: frames so dense that no point moves further than it may between two of them."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

# Speeds are looked up this often; between two look-ups they count as steady.
_GRID_US = 500
# Even where nothing moves there are frames this often.
MAX_INTERVAL_US = 10_000
# Poses per round, to bound the memory that a large mesh and a long scene would take.
_POSES_PER_ROUND = 2048

Way = Callable[[Float[Tensor, "q"]], Float[ndarray, "q-1"]]
"""Furthest way of any point between each two neighbouring times (s), px."""


def frame_motion(way_px: Way, t_us: Int[ndarray, "p"]) -> Float[ndarray, "p-1"]:
    """Furthest way of any point between each two neighbouring times, px."""
    parts = [t_us[first : first + _POSES_PER_ROUND + 1] for first in range(0, len(t_us) - 1, _POSES_PER_ROUND)]
    return np.concatenate([way_px(torch.from_numpy(part).double() * 1e-6) for part in parts])


def frame_times(way_px: Way, duration_us: int, max_motion_px: float, max_interval_us: float = MAX_INTERVAL_US) -> tuple[Int[ndarray, "p"], float]:
    """Times (µs) from 0 to ``duration_us``, both included, and the furthest way of any point between two of them (px).

    Frames are equally far apart in image motion, not in time.
    """
    grid = np.append(np.arange(0, duration_us, _GRID_US), duration_us)
    # Time counts as motion too, so that the interval stays bounded where nothing moves.
    way = np.maximum(frame_motion(way_px, grid), np.diff(grid) * (max_motion_px / max_interval_us))
    travelled = np.concatenate([[0.0], np.cumsum(way)])
    intervals = int(np.ceil(travelled[-1] / max_motion_px))
    while True:
        t_us = np.interp(np.linspace(0, travelled[-1], intervals + 1), travelled, grid)
        t_us = np.unique(np.rint(t_us).astype(np.int64))
        worst = float(frame_motion(way_px, t_us).max())
        # At one frame per microsecond there is nothing left to refine.
        if worst <= max_motion_px or len(t_us) > duration_us:
            return t_us, worst
        intervals = int(np.ceil(intervals * max(1.01, worst / max_motion_px)))
