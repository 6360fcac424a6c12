"""Images through a lens with distortion: drawn as a pinhole camera sees them, then bent as the lens bends them.

The ideal image is drawn as large as the sensor's view without the lens, sampled as finely, and looked up with cubic
interpolation; the lens blur comes after that.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchtrack.core.camera import Camera, distort, undistortion_table
from torchtrack.sim.drawing import Region, merge_regions
from torchtrack.sim.render import Frame, RenderConfig, Renderer, Scenery, blurred
from torchtrack.sim.surface import Parts

# Ideal pixels beyond the sensor's view, for interpolation at its border.
_MARGIN_PX = 4
# A region's border is followed in steps of so many pixels.
_BORDER_STEP_PX = 8


def ideal_camera(camera: Camera) -> Camera:
    """The pinhole camera that sees what the camera sees, without its distortion: the same scale, and as large as it takes."""
    if camera.distortion_model == "none":
        return camera
    table = undistortion_table(camera).numpy()
    low = np.floor(table.min(axis=(0, 1))).astype(int) - _MARGIN_PX
    high = np.ceil(table.max(axis=(0, 1))).astype(int) + _MARGIN_PX
    width, height = (high - low + 1).tolist()
    return Camera(camera.fx, camera.fy, camera.cx - low[0], camera.cy - low[1], width, height, derived=True)


class LensRenderer:
    """A :class:`Renderer` behind a lens.

    Args:
        objects: what to draw; one may have parts with a texture each.
        camera: with distortion.
        background: luminance as the :func:`ideal_camera` sees it.
        config: light and sampling.
    """

    def __init__(self, objects: Sequence[Parts], camera: Camera, background: Float[ndarray, "h w"], config: RenderConfig) -> None:
        self.camera, self.config, self._ideal = camera, config, ideal_camera(camera)
        self._renderer = Renderer(objects, self._ideal, background, config.model_copy(update={"lens_blur_px": 0.0}))
        shift = np.array([self._ideal.cx - camera.cx, self._ideal.cy - camera.cy])
        table = undistortion_table(camera).numpy() + shift
        self._u, self._v = (np.ascontiguousarray(table[..., axis], dtype=np.float32) for axis in (0, 1))
        self._shift = shift

    def render(self, T_cam_obj: Float[ndarray, "o 4 4"] | Float[Tensor, "o 4 4"], scenery: Scenery | None = None) -> Frame:
        """One image of all objects at their poses; see :meth:`Renderer.render`."""
        ideal = self._renderer.render(T_cam_obj, scenery)
        luminance = cv2.remap(ideal.luminance, self._u, self._v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(min=0)
        depth, owner = (
            cv2.remap(image, self._u, self._v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) for image in (ideal.depth, ideal.object_index)
        )
        boxes = [box for region in ideal.regions if (box := self._bent(region)) is not None]
        return Frame(blurred(luminance, self.config.lens_blur_px), depth, owner, merge_regions(boxes))

    def _bent(self, region: Region) -> Region | None:
        """The rectangle of the sensor around a rectangle of the ideal image."""
        u = np.append(np.arange(region.left, region.right, _BORDER_STEP_PX), region.right)
        v = np.append(np.arange(region.top, region.bottom, _BORDER_STEP_PX), region.bottom)
        sides = [
            (u, np.full(len(u), region.top)),
            (u, np.full(len(u), region.bottom)),
            (np.full(len(v), region.left), v),
            (np.full(len(v), region.right), v),
        ]
        border = np.concatenate([np.stack(side, 1) for side in sides]) - self._shift
        seen = distort(border, self.camera)
        size = [self.camera.width, self.camera.height]
        low = np.clip(np.floor(seen.min(0)) - _MARGIN_PX, 0, size).astype(int).tolist()
        high = np.clip(np.ceil(seen.max(0)) + _MARGIN_PX, 0, size).astype(int).tolist()
        return Region(low[1], high[1], low[0], high[0]) if low[0] < high[0] and low[1] < high[1] else None
