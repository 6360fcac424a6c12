"""Fewer pixels: a part of the sensor, or several pixels as one; and the camera that belongs to it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.io.filters.stage import Stage


@dataclass(frozen=True)
class Region(Stage):
    """Events within a part of the sensor, with pixels counted from its corner.

    Args:
        inner: the stream.
        left, top: the corner (px).
        columns, rows: size of the region (px).

    Raises:
        EventDataError: if the region is not within the sensor.
    """

    left: int
    top: int
    columns: int
    rows: int

    def __post_init__(self) -> None:
        _check_region(self.left, self.top, self.columns, self.rows, self.inner.width, self.inner.height)

    @property
    def width(self) -> int:  # type: ignore[override]
        """Width of the region."""
        return self.columns

    @property
    def height(self) -> int:  # type: ignore[override]
        """Height of the region."""
        return self.rows

    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        for chunk in chunks:
            x, y = chunk.x - self.left, chunk.y - self.top
            inside = (x >= 0) & (x < self.columns) & (y >= 0) & (y < self.rows)
            yield replace(chunk, x=x, y=y)[torch.nonzero(inside)[:, 0]]


@dataclass(frozen=True)
class Downscaled(Stage):
    """Squares of ``factor`` times ``factor`` pixels become one; all events stay. What is left over at the border goes.

    Raises:
        EventDataError: if the factor is not positive, or larger than the sensor.
    """

    factor: int

    def __post_init__(self) -> None:
        _check_factor(self.factor, self.inner.width, self.inner.height)

    @property
    def width(self) -> int:  # type: ignore[override]
        """Width in larger pixels."""
        return self.inner.width // self.factor

    @property
    def height(self) -> int:  # type: ignore[override]
        """Height in larger pixels."""
        return self.inner.height // self.factor

    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        for chunk in chunks:
            x, y = (torch.div(pixels, self.factor, rounding_mode="floor") for pixels in (chunk.x, chunk.y))
            smaller = replace(chunk, x=x, y=y)
            inside = (x < self.width) & (y < self.height)
            yield smaller if bool(inside.all()) else smaller[torch.nonzero(inside)[:, 0]]


def region_camera(camera: Camera, left: int, top: int, columns: int, rows: int) -> Camera:
    """The camera whose image is a part of another one's.

    Raises:
        EventDataError: if the region is not within the image.
    """
    _check_region(left, top, columns, rows, camera.width, camera.height)
    return replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=columns, height=rows, derived=True)


def downscaled_camera(camera: Camera, factor: int) -> Camera:
    """The camera whose pixels are squares of ``factor`` times ``factor`` pixels of another one.

    The centre of pixel ``i`` is at ``i``, so its left border is at ``i - 1/2``: ``u' = (u + 1/2) / factor - 1/2``.

    Raises:
        EventDataError: if the factor is not positive, or larger than the image.
    """
    _check_factor(factor, camera.width, camera.height)
    return replace(
        camera,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=(camera.cx + 0.5) / factor - 0.5,
        cy=(camera.cy + 0.5) / factor - 0.5,
        width=camera.width // factor,
        height=camera.height // factor,
        derived=True,
    )


def _check_region(left: int, top: int, columns: int, rows: int, width: int, height: int) -> None:
    if min(left, top) < 0 or min(columns, rows) < 1 or left + columns > width or top + rows > height:
        raise EventDataError(f"the region of {columns}x{rows} pixels at ({left}, {top}) is not within the sensor of {width}x{height} pixels.")


def _check_factor(factor: int, width: int, height: int) -> None:
    if not 1 <= factor <= min(width, height):
        raise EventDataError(f"the factor must lie between 1 and {min(width, height)} for a sensor of {width}x{height} pixels, got {factor}.")
