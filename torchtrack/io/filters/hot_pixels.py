"""Pixels that fire all the time, whatever they see."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.io.event_source import EventSource
from torchtrack.io.filters.stage import Stage

_PARTS, _ENOUGH_PARTS = 10, 8


@dataclass(frozen=True)
class HotPixelFilter(Stage):
    """A stream without the events of some pixels.

    Args:
        inner: the stream.
        hot: ``[height, width]``, true where a pixel is left out; :func:`find_hot_pixels` finds them.

    Raises:
        EventDataError: if it is not of the size of the sensor.
    """

    hot: Bool[Tensor, "h w"] = field(repr=False)

    def __post_init__(self) -> None:
        if self.hot.shape != (self.inner.height, self.inner.width):
            raise EventDataError(f"hot must be [{self.inner.height}, {self.inner.width}] as the sensor is, got {list(self.hot.shape)}.")

    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        for chunk in chunks:
            keep = ~self.hot[chunk.y.long(), chunk.x.long()]
            yield chunk[torch.nonzero(keep)[:, 0]]


def find_hot_pixels(source: EventSource, duration_us: int = 500_000, min_rate: float = 50.0, ratio: float = 10.0) -> Bool[Tensor, "h w"]:
    """Pixels that fire much more than their neighbours do, over the beginning of a stream.

    An edge that passes makes neighbours fire as well, and passes; a hot pixel fires alone, and in at least eight of ten equal
    parts of the time. Where two of them touch, the second busiest of a pixel's eight neighbours is what counts.

    Args:
        source: the stream.
        duration_us: how much of it to look at.
        min_rate: a hot pixel fires so often (events per second), at least.
        ratio: and so many times as often as the second busiest of its neighbours.

    Returns:
        ``[height, width]``, true where a pixel is hot.
    """
    width, height = source.width, source.height
    counts = np.zeros(height * width, np.int64)
    fired = np.zeros((_PARTS, height * width), bool)
    first_us: int | None = None
    last_us = 0
    for chunk in source.chunks():
        first_us = int(chunk.t_us[0]) if first_us is None else first_us
        chunk = chunk.slice_time(first_us - 1, first_us + duration_us)
        if len(chunk) == 0:
            break
        last_us = int(chunk.t_us[-1])
        pixels = (chunk.y.long() * width + chunk.x).numpy()
        counts += np.bincount(pixels, minlength=len(counts))
        fired[np.minimum((chunk.t_us.numpy() - first_us) * _PARTS // duration_us, _PARTS - 1), pixels] = True
    image = np.pad(counts.reshape(height, width), 1)
    places = [(dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1)]
    neighbours = np.sort(np.stack([image[dy : dy + height, dx : dx + width] for dy, dx in places]), axis=0)[-2]
    span_us = max(last_us - (first_us or 0), 1)
    centre = image[1:-1, 1:-1]
    # A stream may be shorter than what was to be looked at.
    enough = _ENOUGH_PARTS * min(span_us / duration_us, 1.0)
    lasting = fired.sum(0).reshape(height, width) >= enough
    return torch.from_numpy(lasting & (centre >= min_rate * 1e-6 * span_us) & (centre > ratio * (neighbours + 1)))
