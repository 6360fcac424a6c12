"""The photoreceptor before an event pixel: a first-order low pass of the log luminance, slower in the dark."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

# Light below which the photoreceptor gets no slower, where 1 is white (v2e: 20 of 255).
_SLOWEST_LIGHT = 20 / 255


def cutoff_hz(luminance: Float[Tensor, "*b"], bandwidth_hz: float) -> Float[Tensor, "*b"]:
    """Cutoff at a luminance: proportional to the light, ``bandwidth_hz`` at white."""
    return bandwidth_hz * (luminance.clamp(0, 1) + _SLOWEST_LIGHT) / (1 + _SLOWEST_LIGHT)


def response(
    level: Float[Tensor, "*b"], before: Float[Tensor, "*b"], after: Float[Tensor, "*b"], cutoff: Float[Tensor, "*b"], duration_s: float
) -> Float[Tensor, "*b"]:
    """Level of the photoreceptor after an interval.

    Args:
        level: at the start.
        before, after: log luminance at both ends, a straight line between.
        cutoff: in Hz.
        duration_s: length of the interval, s.

    Returns:
        The exact solution of ``dy/dt = 2π f (x - y)``.
    """
    rate = 2 * math.pi * cutoff
    lag = (after - before) / (rate * duration_s)
    return after - lag + (level - before + lag) * torch.exp(-rate * duration_s)
