"""What is remembered of every pixel of the sensors."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.tracking.frontend.bursts import no_bursts
from torchtrack.tracking.frontend.time_surface import empty_last_event


@dataclass(frozen=True)
class SensorMaps:
    """Maps of the sensors of all streams.

    Args:
        last_event_us: time of the newest event of every sensor pixel (µs).
        burst_age_us: how long ago the newest burst of every sensor pixel and polarity began (µs).
    """

    last_event_us: Int[Tensor, "s h w"]
    burst_age_us: Int[Tensor, "s 2 h w"]

    @classmethod
    def empty(cls, streams: int, image_size: tuple[int, int], device: torch.device) -> "SensorMaps":
        """Maps of sensors of (height, width) that no event has come from."""
        return cls(empty_last_event(streams, *image_size, device), no_bursts(streams, *image_size, device))
