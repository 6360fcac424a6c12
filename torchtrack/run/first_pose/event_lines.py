"""The events at the start as lines: how near every pixel of a view is to events that lie along a line of a given direction.

In go the pixels and ages of events in a view, out comes an image of them, moved back to the start with the velocity that makes it sharpest
(contrast maximisation: Gallego, Rebecq and Scaramuzza, "A unifying contrast maximization framework for event cameras", 2018), and a table over
direction, row and column of how near events are (directional chamfer matching: Liu, Tuzel, Veeraraghavan and Chellappa, "Fast directional
chamfer matching", 2010).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchtrack.run.first_pose.start import Box
from torchtrack.tracking.relocalization.event_image import event_density

# Directions that lines are told apart by, and how far (px) a step between two of them is taken to be.
DIRECTIONS, _DIRECTION_PX = 8, 1.0
# Events count for a pixel up to this far (px): for a first look at rotations some ten degrees apart, and for the last.
COARSE_PX, FINE_PX = 7.0, 2.5
# A pixel has events if the 3x3 around it have this share of what those with most of them have.
_SHARE, _MOST = 0.25, 0.8
# Where the structure tensor is so much rounder than a line, events count for all directions.
_LINE = 0.35
# Velocities are tried that move the events by up to so much (px), in ever smaller steps.
_FARTHEST_PX, _STEPS_PX = 24.0, (3.0, 1.0, 0.35)
_EVENTS = 15_000


@dataclass(frozen=True)
class EventLines:
    """The events of a view at the start.

    Args:
        coarse, fine: how near events along each direction are to each pixel: 1 for there, 0 for farther than ``COARSE_PX`` or ``FINE_PX``.
        weights: how much each pixel's events count of all, in sum 1.
        density: events in the 3x3 pixels around each pixel, with a border, as relocalization looks them up.
        velocity_px: the way of the events in the time that was looked at (px).
    """

    coarse: Float[Tensor, "o h w"]
    fine: Float[Tensor, "o h w"]
    weights: Float[Tensor, "h w"]
    density: Float[Tensor, "h2 w2"]
    velocity_px: Float[Tensor, "2"]

    @classmethod
    def from_events(cls, pixels: Float[Tensor, "e 2"], fraction: Float[Tensor, "e"], box: Box, side_px: int) -> "EventLines":
        """Of events in a view.

        Args:
            pixels: where they are.
            fraction: when they came, of the time that is looked at.
            box: where the object is.
            side_px: width and height of the view.
        """
        velocity_px = sharpest_velocity(*_some(pixels, fraction, box), side_px)
        places = pixels - velocity_px * fraction[:, None]
        density = event_density(places[None], torch.ones(1, len(places), dtype=torch.bool), (side_px, side_px))[0]
        inner = density[2:-2, 2:-2]
        enough = _usual_density(inner)
        level = (inner / enough).clamp(max=1)
        near = _distances(level.numpy())
        coarse, fine = ((1 - torch.from_numpy(near) / reach_px).clamp(min=0) for reach_px in (COARSE_PX, FINE_PX))
        weights = level * (level > _SHARE) * _inside(box.grown(0.1), side_px)
        return cls(coarse, fine, weights / weights.sum().clamp(min=1e-6), density / enough, velocity_px)


def _usual_density(density: Tensor) -> float:
    busy = density[density > 0]
    return max(float(busy.quantile(_MOST)), 1.0) if len(busy) else 1.0


def direction_of(normals: Float[Tensor, "*n 2"]) -> Int[Tensor, "*n"]:
    """The number of the direction of a line with a normal; opposite normals are of the same line."""
    return (torch.atan2(normals[..., 1], normals[..., 0]) * (DIRECTIONS / math.pi)).round().long() % DIRECTIONS


def near_events(table: Float[Tensor, "o h w"], pixels: Float[Tensor, "*n 2"], directions: Int[Tensor, "*#n"]) -> Float[Tensor, "*n"]:
    """What a table of an :class:`EventLines` has at some pixels; zero outside."""
    _, height, width = table.shape
    u, v = pixels.round().nan_to_num(-1.0).unbind(-1)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    place = torch.where(inside, v * width + u, 0).long() + directions * (height * width)
    return table.flatten()[place] * inside


def sharpest_velocity(pixels: Float[Tensor, "e 2"], fraction: Float[Tensor, "e"], side_px: int) -> Float[Tensor, "2"]:
    """The way (px) in the whole time for which the events, moved back along it, lie on the fewest pixels."""
    best, reach_px = pixels.new_zeros(2), _FARTHEST_PX
    for step_px in _STEPS_PX:
        steps = torch.arange(-reach_px, reach_px + step_px / 2, step_px)
        ways = best + torch.cartesian_prod(steps, steps)
        best = ways[torch.stack([_contrast(pixels - way * fraction[:, None], side_px) for way in ways]).argmax()]
        reach_px = step_px
    return best


def _contrast(places: Float[Tensor, "e 2"], side_px: int) -> Float[Tensor, ""]:
    u, v = places.round().long().clamp(0, side_px - 1).unbind(-1)
    counts = torch.bincount(v * side_px + u, minlength=side_px**2).view(1, side_px, side_px).float()
    return avg_pool2d(counts.clamp(max=50), 3, 1, 1).square().sum()


def _some(pixels: Tensor, fraction: Tensor, box: Box) -> tuple[Tensor, Tensor]:
    """The events in the box, every so many of them."""
    inside = box.holds(pixels).nonzero()[:, 0]
    chosen = inside[:: max(1, len(inside) // _EVENTS)]
    return pixels[chosen], fraction[chosen]


def _inside(box: Box, side_px: int) -> Float[Tensor, "h w"]:
    along = torch.arange(side_px, dtype=torch.float32)
    u, v = torch.meshgrid(along, along, indexing="xy")
    return box.holds(torch.stack([u, v], -1)).float()


def _distances(level: Float[ndarray, "h w"]) -> Float[ndarray, "o h w"]:
    """How far events along each direction are (px), a step between directions counted as ``_DIRECTION_PX``."""
    busy = level > _SHARE
    angle, is_line = _line_normals(level)
    own = np.round(angle * (DIRECTIONS / np.pi)).astype(np.int64) % DIRECTIONS
    nearest = np.stack([_distance_to(busy & ((own == direction) | ~is_line)) for direction in range(DIRECTIONS)])
    for _ in range(DIRECTIONS // 2):
        neighbours = np.minimum(np.roll(nearest, 1, 0), np.roll(nearest, -1, 0)) + _DIRECTION_PX
        nearest = np.minimum(nearest, neighbours)
    return nearest


def _distance_to(mask: ndarray) -> Float[ndarray, "h w"]:
    if not mask.any():
        return np.full(mask.shape, 1e3, np.float32)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def _line_normals(level: Float[ndarray, "h w"]) -> tuple[Float[ndarray, "h w"], ndarray]:
    """The angle of the normal of what looks like a line around each pixel, and where it does: by the structure tensor."""
    smooth = cv2.GaussianBlur(level.astype(np.float32), (0, 0), 1.0)
    du, dv = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    uu, vv, uv = (cv2.GaussianBlur(product, (0, 0), 2.0) for product in (du * du, dv * dv, du * dv))
    length = np.sqrt((uu - vv) ** 2 + 4 * uv**2)
    return 0.5 * np.arctan2(2 * uv, uu - vv), length > _LINE * (uu + vv + 1e-9)
