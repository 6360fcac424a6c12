"""When anything last happened at a pixel: the newest events of each stream, looked up by where a lens without distortion puts them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchtrack.core.constants import constant
from torchtrack.tracking.frontend.time_surface import at_pixels, by_number

# Pixels this far outside the image still find their place on a distorted sensor (px).
BORDER_PX = 64


@dataclass(frozen=True)
class History:
    """The newest event at every pixel of each object's stream, up to the end of a window.

    Args:
        sensor_numbers: number of the sensor pixel nearest to every ideal pixel, with a border, from :func:`pixel_numbers`.
        stream_index: the stream that each object is seen in.
        last_event_us: time of the newest event at each sensor pixel.
        t_us: end of the window of each stream.
    """

    sensor_numbers: Int[Tensor, "s bh bw"]
    stream_index: Int[Tensor, "b"]
    last_event_us: Int[Tensor, "s h w"]
    t_us: Int[Tensor, "s"]

    def age_s(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n"]:
        """Time since the newest event (s) at ideal pixels, rounded to whole ones; huge where there never was any."""
        stream, number = self.stream_index[:, None], numbers_of(self.sensor_numbers, self.stream_index, pixels)
        return (self.t_us[stream] - by_number(self.last_event_us, stream, number)).to(pixels.dtype) * 1e-6


def on_sensor(sensor_pixels: Float[Tensor, "s bh bw 2"], stream_index: Int[Tensor, "b"], pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
    """Where the lens puts ideal pixels."""
    return at_pixels(sensor_pixels, stream_index[:, None], *_in_table(sensor_pixels, pixels))


def numbers_of(sensor_numbers: Int[Tensor, "s bh bw"], stream_index: Int[Tensor, "b"], pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n"]:
    """Numbers of the sensor pixels nearest to ideal ones, by the table from :func:`pixel_numbers`."""
    return at_pixels(sensor_numbers, stream_index[:, None], *_in_table(sensor_numbers, pixels))


def pixel_numbers(sensor_pixels: Float[Tensor, "s bh bw 2"], image_size: tuple[int, int]) -> Int[Tensor, "s bh bw"]:
    """Numbers, row by row in an image of (height, width), of the whole pixels nearest to those of a table: half the memory, and nothing to round."""
    height, width = image_size
    limit = constant((width - 1, height - 1), sensor_pixels.dtype, sensor_pixels.device)
    column, row = torch.minimum(sensor_pixels.round().clamp(min=0), limit).int().unbind(-1)
    return torch.add(column, row, alpha=width)


def _in_table(table: Shaped[Tensor, "s bh bw *c"], pixels: Float[Tensor, "b n 2"]) -> tuple[Int[Tensor, "b n"], Int[Tensor, "b n"]]:
    """Columns and rows of ideal pixels in a table of them with a border."""
    height, width = table.shape[1:3]
    # Clamped before the conversion: a far-off pixel does not fit an integer.
    limit = constant((width - 1, height - 1), pixels.dtype, pixels.device)
    column, row = torch.minimum((pixels + BORDER_PX).clamp(min=0), limit).round().long().unbind(-1)
    return column, row
