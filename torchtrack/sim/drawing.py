"""What a renderer asks of those that draw triangles: the numba rasteriser and OpenGL do it behind the same few methods."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels, ends excluded."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the rectangle in an image ``[H, W]``."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def overlaps(self, other: "Region") -> bool:
        """Whether the two share a pixel."""
        return self.top < other.bottom and other.top < self.bottom and self.left < other.right and other.left < self.right

    def union(self, other: "Region") -> "Region":
        """The smallest rectangle around both."""
        return Region(min(self.top, other.top), max(self.bottom, other.bottom), min(self.left, other.left), max(self.right, other.right))


def merge_regions(regions: Sequence[Region]) -> tuple[Region, ...]:
    """Rectangles that overlap, joined until none do."""
    merged: list[Region] = []
    for region in regions:
        while overlapping := [other for other in merged if other.overlaps(region)]:
            for other in overlapping:
                merged.remove(other)
                region = region.union(other)
        merged.append(region)
    return tuple(merged)


@dataclass(frozen=True)
class Light:
    """One distant light and ambient light.

    Args:
        ambient, diffuse: shares of light.
        direction: towards the distant light, camera frame; its length does not matter.
    """

    ambient: float
    diffuse: float
    direction: tuple[float, float, float]

    @property
    def unit(self) -> Float[ndarray, "3"]:
        """The direction, of length 1."""
        light = np.array(self.direction)
        return (light / max(np.linalg.norm(light), 1e-12)).astype(np.float32)


class Picture(NamedTuple):
    """What is drawn into.

    Args:
        luminance: linear; that of the background at first.
        depth: m; infinite where there is no object.
        object_index: number of the object that is seen, -1 where there is none.
    """

    luminance: Float[ndarray, "rows columns"]
    depth: Float[ndarray, "rows columns"]
    object_index: Int[ndarray, "rows columns"]


@runtime_checkable
class Drawer(Protocol):
    """Draws the objects of one scene, sample by sample."""

    def place(self, T_cam_obj: Float[ndarray, "o 4 4"], light: Light) -> list[Float[ndarray, "_ 3"]]:
        """Set poses and light for the next image; returns corners of every object in the camera frame."""
        ...

    def draw(self, region: Region, numbers: Sequence[int], picture: Picture) -> None:
        """Draw some of the objects into one region, over the background that its picture holds."""
        ...


def sample_offsets(n: int) -> Float[ndarray, "s 2"]:
    """Offsets (u, v) of ``n x n`` samples from the centre of a pixel, pixels: no two share a column or a row."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    u, v = (i + (j + 0.5) / n) / n - 0.5, (j + (i + 0.5) / n) / n - 0.5
    return np.stack([u.ravel(), v.ravel()], 1)
