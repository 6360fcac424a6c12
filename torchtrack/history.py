"""When anything last happened at a pixel: the newest events of each stream, looked up by where a lens without distortion puts them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.constants import constant
from torchtrack.time_surface import at_pixels

# Pixels this far outside the image still find their place on a distorted sensor (px).
BORDER_PX = 64


@dataclass(frozen=True)
class History:
    """The newest event at every pixel of each object's stream, up to the end of a window.

    Args:
        sensor_pixels: sensor pixel of every ideal pixel, with a border.
        stream_index: the stream that each object is seen in.
        last_event_us: time of the newest event at each sensor pixel.
        t_us: end of the window of each stream.
    """

    sensor_pixels: Float[Tensor, "s bh bw 2"]
    stream_index: Int[Tensor, "b"]
    last_event_us: Int[Tensor, "s h w"]
    t_us: Int[Tensor, "s"]

    def age_s(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n"]:
        """Time since the newest event (s) at ideal pixels, rounded to whole ones; huge where there never was any."""
        height, width = self.last_event_us.shape[1:]
        limit = constant((width - 1, height - 1), pixels.dtype, pixels.device)
        placed = on_sensor(self.sensor_pixels, self.stream_index, pixels)
        u, v = torch.minimum(placed.round().clamp(min=0), limit).long().unbind(-1)
        age_us = self.t_us[self.stream_index, None] - at_pixels(self.last_event_us, self.stream_index[:, None], u, v)
        return age_us.to(pixels.dtype) * 1e-6


def on_sensor(sensor_pixels: Float[Tensor, "s bh bw 2"], stream_index: Int[Tensor, "b"], pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
    """Where the lens puts ideal pixels."""
    height, width = sensor_pixels.shape[1:3]
    # Clamped before the conversion: a far-off pixel does not fit an integer.
    limit = constant((width - 1, height - 1), pixels.dtype, pixels.device)
    u, v = torch.minimum((pixels + BORDER_PX).clamp(min=0), limit).round().long().unbind(-1)
    return at_pixels(sensor_pixels, stream_index[:, None], u, v)
