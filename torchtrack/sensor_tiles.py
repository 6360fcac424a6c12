"""Events near the objects: what lies elsewhere on the sensor is left out before anything is computed of it.

The sensor is laid out in tiles of whole pixels. One look at each event's tile, in integers, tells whether any object can be there.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchtrack.camera import MIN_DEPTH_M, project
from torchtrack.events import EventBatch
from torchtrack.prediction import Prediction

# Side of a tile (px, as a power of two).
_TILE_BITS = 4
# Objects are expected within this many standard deviations of their prediction.
_SIGMAS = 4.0
# What is looked up near contours is so much coarser than a pixel (px).
_SLACK_PX = 4.0
# Where more than this share of the events is near objects, leaving the others out is not worth the copy.
_MOST_KEPT = 0.8


class SensorTiles(nn.Module):
    """The tiles of one sensor: where their middles are in ideal pixels, and how far their pixels reach from there."""

    middle: Tensor
    reach_px: Tensor

    def __init__(self, ideal_pixels: Float[Tensor, "h w 2"]) -> None:
        """Take the tiles from the undistortion table of the sensor."""
        super().__init__()
        height, width = ideal_pixels.shape[:2]
        side = 1 << _TILE_BITS
        self.columns = -(-width // side)
        rows, columns = (torch.arange(side // 2, side // 2 + extent, side).clamp(max=extent - 1) for extent in (height, width))
        self.register_buffer("middle", ideal_pixels[rows[:, None], columns].flatten(0, 1))
        tile = self._of(*torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")).flatten()
        from_middle = (ideal_pixels.flatten(0, 1) - self.middle[tile]).norm(dim=-1)
        self.register_buffer("reach_px", torch.zeros(len(self.middle)).scatter_reduce(0, tile, from_middle, "amax"))

    def _of(self, x: Int[Tensor, "*n"], y: Int[Tensor, "*n"]) -> Int[Tensor, "*n"]:
        """The tile of each pixel."""
        return torch.add(x >> _TILE_BITS, y >> _TILE_BITS, alpha=self.columns).long()

    def near(self, prediction: Prediction, window_s: Float[Tensor, "b"], margin_px: float) -> Bool[Tensor, "t"]:
        """Tiles that anything can be seen in, within a window before ``prediction``, that is no farther than a margin from an object."""
        objects, (turning, speed_m_s) = prediction.objects, prediction.velocity.unflatten(1, (2, 3)).norm(dim=-1).unbind(1)
        turned, moved, *_ = prediction.covariance.diagonal(dim1=-2, dim2=-1).unflatten(1, (4, 3)).amax(-1).sqrt().to(turning.dtype).unbind(1)
        rim_m = 0.5 * objects.diameter_m
        radius_m = rim_m + (speed_m_s + rim_m * turning) * window_s + _SIGMAS * (moved + rim_m * turned)
        x, y, z = prediction.centre_cam.unbind(1)
        # No point of a sphere is farther from its middle in the image: by the derivative of x/z along any way in it.
        slant = (1 + (x * x + y * y) / (z * z)).sqrt()
        radius_px = objects.intrinsics[:, :2].amax(1) * slant * radius_m / (z - radius_m).clamp(min=MIN_DEPTH_M)
        u, v = (
            tiles - objects_at
            for tiles, objects_at in zip(self.middle.T, project(prediction.centre_cam[:, None], objects.intrinsics).unbind(-1), strict=True)
        )
        away_px = (u * u + v * v).sqrt() - self.reach_px
        # Written so that what is not a number is near.
        return ~(away_px > radius_px[:, None] + (margin_px + _SLACK_PX)).all(0)

    def keep(self, events: EventBatch, near: Bool[Tensor, "t"]) -> tuple[EventBatch, Int[Tensor, "e"] | None]:
        """The events in some tiles and their numbers; all of them, and no numbers, where these are most of them."""
        # NumPy finds them several times faster.
        kept = torch.from_numpy(np.flatnonzero(near.index_select(0, self._of(events.x, events.y)).numpy()))
        if len(kept) > _MOST_KEPT * len(events):
            return events, None
        # Padding, which stands for no event at all, has no number.
        return events[kept], kept if len(kept) else None
