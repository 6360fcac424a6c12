"""Events near the objects: what lies elsewhere on the sensor is left out before anything is computed of it.

Each sensor is laid out in tiles of whole pixels. One look at each event's tile, in integers, tells whether any object can be there.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.core.events import EventBatch, check_on_sensor
from torchtrack.core.lie import transform_points
from torchtrack.tracking.motion.prediction import Prediction

# Side of a tile (px, as a power of two).
TILE_BITS = 3
# Objects are expected within this many standard deviations of their prediction.
SIGMAS = 4.0
# What is looked up near contours is so much coarser than a pixel (px).
SLACK_PX = 4.0
# Corners of a box, in halves of its sides from its middle.
_CORNERS = tuple(product((-1.0, 1.0), repeat=3))


@dataclass(frozen=True)
class NearbyEvents:
    """The events of a window that can have to do with any object.

    Args:
        events: the events.
        number: of each among all of the window, where some were left out; of one stream alone.
        are_in_map: whether the map of bursts has been brought up with them already.
        near_tiles: tiles near each object, where the events in them are still to be chosen.
    """

    events: EventBatch
    number: Int[Tensor, "e"] | None = None
    are_in_map: bool = False
    near_tiles: Bool[Tensor, "b t"] | None = None


class SensorTiles(nn.Module):
    """The tiles of each stream's sensor: where their middles are in ideal pixels, and how far their pixels reach from there."""

    middle: Tensor
    reach_px: Tensor

    def __init__(self, ideal_pixels: Float[Tensor, "s h w 2"]) -> None:
        """Take the tiles from the undistortion tables of the sensors."""
        super().__init__()
        self.height, self.width = height, width = ideal_pixels.shape[1:3]
        side = 1 << TILE_BITS
        self.columns = -(-width // side)
        rows, columns = (torch.arange(side // 2, side // 2 + extent, side).clamp(max=extent - 1) for extent in (height, width))
        self.register_buffer("middle", ideal_pixels[:, rows[:, None], columns].flatten(1, 2))
        tile = self.tile_of(*torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")).flatten()
        from_middle = (ideal_pixels.flatten(1, 2) - self.middle[:, tile]).norm(dim=-1)
        nowhere = torch.zeros_like(self.middle[..., 0])
        self.register_buffer("reach_px", nowhere.scatter_reduce(1, tile.expand_as(from_middle), from_middle, "amax"))

    def tile_of(self, x: Int[Tensor, "*n"], y: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        """The tile of each pixel."""
        return torch.add(x >> TILE_BITS, y >> TILE_BITS, alpha=self.columns).long()

    @accelerable
    def near(self, prediction: Prediction, window_s: Float[Tensor, "b"], margin_px: float) -> Bool[Tensor, "b t"]:
        """Tiles that anything can be seen in, within a window before ``prediction``, that is no farther than a margin from each object."""
        objects, (turning, speed_m_s) = prediction.objects, prediction.velocity.unflatten(1, (2, 3)).norm(dim=-1).unbind(1)
        turned, moved, *_ = prediction.covariance.diagonal(dim1=-2, dim2=-1).unflatten(1, (4, 3)).amax(-1).sqrt().to(turning.dtype).unbind(1)
        rim_m = 0.5 * objects.diameter_m
        within_m = ((speed_m_s + rim_m * turning) * window_s + SIGMAS * (moved + rim_m * turned))[:, None]
        corners_obj = objects.centre_obj[:, None] + constant(_CORNERS, turning.dtype, turning.device) * objects.half_extent[:, None]
        corners = transform_points(prediction.T_cam_obj, corners_obj)
        nearest_m, slope = corners[..., 2] - within_m, corners[..., :2] / corners[..., 2:]
        # No point of a ball is farther from its middle along an axis of the image: by the derivative of x/z along any way in it.
        around_px = objects.intrinsics[:, None, :2] * (1 + slope * slope).sqrt() * (within_m / nearest_m)[..., None]
        # Written so that what is not a number, or may lie beside or behind the camera, is near everywhere.
        around_px = torch.where((nearest_m > MIN_DEPTH_M)[..., None], around_px, torch.inf) + (margin_px + SLACK_PX)
        at = project(corners, objects.intrinsics)
        low, high = (at - around_px).amin(1), (at + around_px).amax(1)
        middle, reach_px = self.middle[objects.stream_index], self.reach_px[objects.stream_index, :, None]
        return ((middle + reach_px >= low[:, None]) & (middle - reach_px <= high[:, None])).all(-1)

    def keep(self, events: EventBatch, near: Bool[Tensor, "b t"]) -> NearbyEvents:
        """The events of one stream in tiles near any object.

        Raises:
            EventDataError: if an event is outside the sensor.
        """
        check_on_sensor(events, self.width, self.height)
        # NumPy finds them several times faster.
        kept = np.flatnonzero(near.any(0).numpy()[self.tile_of(events.x, events.y).numpy()])
        if len(kept) == 0:
            # Padding, which stands for no event at all, has no number and is near nothing.
            return NearbyEvents(EventBatch.empty())
        number = torch.from_numpy(kept)
        return NearbyEvents(events) if len(kept) == len(events) else NearbyEvents(events[number], number)
