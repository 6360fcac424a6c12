"""What a first pose is looked for in: the model, the camera, and the events after the time that the pose is of."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from torchtrack.core.camera import Camera, undistortion_table
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.windows import clipped
from torchtrack.errors import EventDataError
from torchtrack.io import EventSource
from torchtrack.object_model import ObjectModel
from torchtrack.run.session import Session

# So long after the start is looked at, and so many events of it, at most.
LOOKED_AT_US, _MOST_EVENTS = 300_000, 6_000_000


@dataclass(frozen=True)
class Start:
    """An object at the start of a recording, or of a part of it.

    Args:
        model: of the object.
        camera: that sees it.
        events: after the start, at most ``LOOKED_AT_US`` of them.
        pixels: ideal pixel of each of the events.
        at_us: the time that the pose is of.
    """

    model: ObjectModel
    camera: Camera
    events: EventBatch
    pixels: Float[Tensor, "e 2"]
    at_us: int

    @classmethod
    def from_events(cls, model: ObjectModel, camera: Camera, source: EventSource, at_us: int) -> "Start":
        """With the events of a source.

        Raises:
            EventDataError: if there are none soon after ``at_us``.
        """
        batches, count = [], 0
        for batch in clipped(source.chunks(), at_us, at_us + LOOKED_AT_US):
            batches.append(batch)
            count += len(batch)
            if count >= _MOST_EVENTS:
                break
        if not batches:
            raise EventDataError(f"no events within {1e-6 * LOOKED_AT_US:g} s after {at_us} µs: nothing moves then. Give a later time (--at-us).")
        events = concatenate(batches)[:_MOST_EVENTS]
        pixels = undistortion_table(camera)[events.y.long(), events.x.long()]
        return cls(model, camera, events, pixels, at_us)

    @classmethod
    def from_session(cls, session: Session) -> "Start":
        """Of the first object of a session, at its start."""
        return cls.from_events(session.models[0], session.camera, session.events, session.start_us)

    @property
    def age_s(self) -> Float[Tensor, "e"]:
        """How long after the start each event came (s)."""
        return 1e-6 * (self.events.t_us - self.at_us).float()


@dataclass(frozen=True)
class Box:
    """A part of the image around an object, in pixels.

    Args:
        u0, v0, u1, v1: its sides: left, top, right and bottom.
    """

    u0: float
    v0: float
    u1: float
    v1: float

    @property
    def centre(self) -> Float[Tensor, "2"]:
        """Its middle."""
        return torch.tensor([(self.u0 + self.u1) / 2, (self.v0 + self.v1) / 2])

    @property
    def size(self) -> Float[Tensor, "2"]:
        """Its width and height."""
        return torch.tensor([self.u1 - self.u0, self.v1 - self.v0])

    def grown(self, share: float) -> "Box":
        """The box with sides farther out by a share of its width and height."""
        u, v = share * (self.u1 - self.u0), share * (self.v1 - self.v0)
        return Box(self.u0 - u, self.v0 - v, self.u1 + u, self.v1 + v)

    def holds(self, pixels: Float[Tensor, "*n 2"]) -> Bool[Tensor, "*n"]:
        """Which pixels lie in it."""
        u, v = pixels.unbind(-1)
        return (u >= self.u0) & (u <= self.u1) & (v >= self.v0) & (v <= self.v1)

    @classmethod
    def around(cls, pixels: Float[Tensor, "n 2"]) -> "Box":
        """The smallest with all of the pixels in it."""
        low, high = pixels.amin(0).tolist(), pixels.amax(0).tolist()
        return cls(low[0], low[1], high[0], high[1])


# Events are counted in cells of this size (px), and of those with more than a share of what the full ones have, the largest patch is taken.
_CELL_PX, _SHARE = 8, 0.15
# What a quarter of the cells stay below is noise; cells so many of its standard deviations above it are not, where there is any.
_NOISE, _ABOVE_NOISE = 0.25, 4.0


def box_of_events(start: Start, count: int) -> Box:
    """The box around the largest patch of events, of the first ``count`` of them: what moves most before a camera at rest.

    Raises:
        EventDataError: if the events are scattered all over.
    """
    cells = _counts(start, count)
    noise = float(np.quantile(cells, _NOISE))
    least = noise + _ABOVE_NOISE * noise**0.5 + 1.0
    full = np.quantile(cells[cells > least], 0.9) if (cells > least).any() else 0.0
    busy = (cells > max(_SHARE * full, least)).astype(np.uint8)
    joined = cv2.morphologyEx(busy, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    number_of_labels, labels = cv2.connectedComponents(joined)
    if number_of_labels < 2:
        raise EventDataError("the events are scattered all over the image. Say where the object is, with --box u0,v0,u1,v1.")
    number = 1 + int(np.argmax(np.bincount(labels[labels > 0], weights=cells[labels > 0], minlength=number_of_labels)[1:]))
    # Closing fills what lies between a patch and a border of the image nearby, too.
    rows, columns = np.nonzero((labels == number) & (busy > 0))
    left, top, right, bottom = (float(cell * _CELL_PX) for cell in (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
    return Box(left, top, right, bottom)


def _counts(start: Start, count: int) -> Int[ndarray, "h w"]:
    rows, columns = -(-start.camera.height // _CELL_PX), -(-start.camera.width // _CELL_PX)
    u, v = (start.pixels[:count] / _CELL_PX).long().unbind(-1)
    inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    return torch.bincount((v * columns + u)[inside], minlength=rows * columns).view(rows, columns).numpy()
