"""Clocks that send their high bits apart, and wrap around."""

import numpy as np


def unwrap(high: np.ndarray, bits: int, last: int) -> np.ndarray:
    """High parts of a clock with ``bits`` bits, each continued from the one before it, without the wrap.

    A fall by half of the range or more is a wrap; a smaller one is a step back and stays one.

    Args:
        high: the parts, int64.
        bits: how many bits a part has.
        last: the unwrapped part before the first one; its low ``bits`` bits are what the clock showed.
    """
    full = 1 << bits
    before = np.empty_like(high)
    before[0], before[1:] = last % full, high[:-1]
    loops = np.cumsum(before - high >= full // 2)
    return high + full * (loops + last // full)


def spread(values: np.ndarray, ends: np.ndarray, total: int) -> np.ndarray:
    """Values held until the next one: ``values[0]`` up to ``ends[0]``, and so on; the last one up to ``total``."""
    bounds = np.empty(len(values) + 1, np.int64)
    bounds[0], bounds[1:-1], bounds[-1] = 0, ends, total
    return np.repeat(values, np.diff(bounds))
