"""What is behind all objects: a picture that stands before the sensor, on a wall, or at infinity all around.

A picture has about one texel per pixel where it is seen straight on, and is slightly blurred, so that bilinear look-ups
carry it to fractions of a pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from torchtrack.core.camera import Camera

Rays = Float[ndarray, "h w 3"]
Texels = Float[ndarray, "h w 2"]
Placement = Callable[[Rays, Float[ndarray, "3"]], Texels]
"""From directions ``[h, w, 3]`` and a position in the world to texels (u, v) of the picture, in float."""

# Texels are found exactly at every so many pixels, and by straight lines between.
_GRID_PX = 8


def on_sensor(camera: Camera) -> Placement:
    """One texel per pixel, whatever the camera does."""
    return lambda rays, origin: rays[..., :2] / rays[..., 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def on_wall(distance_m: float, texels_per_m: float, centre: tuple[float, float]) -> Placement:
    """On the plane z = distance of the world; its texel ``centre`` lies before the world's origin."""

    def texels(rays: Rays, origin: Float[ndarray, "3"]) -> Texels:
        # Where a ray runs away from the wall it is taken to its edge, far out.
        along = (distance_m - origin[2]) / np.maximum(rays[..., 2:], 1e-3)
        return (origin[:2] + along * rays[..., :2]) * texels_per_m + centre

    return texels


def at_infinity(texels_per_rad: float, centre: tuple[float, float]) -> Placement:
    """All around, equirectangular; its texel ``centre`` lies in the direction of the world's z axis."""

    def texels(rays: Rays, origin: Float[ndarray, "3"]) -> Texels:
        azimuth, elevation = np.arctan2(rays[..., 0], rays[..., 2]), np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
        # No jump within the image: look-ups run straight from one grid point to the next.
        middle = azimuth[azimuth.shape[0] // 2, azimuth.shape[1] // 2]
        azimuth = middle + (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
        return np.stack([azimuth, elevation], -1) * texels_per_rad + centre

    return texels


@dataclass(frozen=True)
class Backdrop:
    """A picture and where it is.

    Args:
        picture: luminance, linear.
        camera: who looks at it.
        placement: from directions in the world to texels.
        follows_camera: whether it stays before the sensor however the camera moves.
        pan_px_s: how fast the picture slides along (u, v), texels per second.
        wraps: whether the picture goes on at its other side sideways, or is mirrored at its borders.
    """

    picture: Float[ndarray, "ph pw"]
    camera: Camera
    placement: Placement
    follows_camera: bool = True
    pan_px_s: tuple[float, float] = (0.0, 0.0)
    wraps: bool = False
    _rays: Rays = field(init=False)

    def __post_init__(self) -> None:
        u, v = (np.append(np.arange(0, size - 1, _GRID_PX), size - 1.0) for size in (self.camera.width, self.camera.height))
        cam = self.camera
        rays = np.stack(np.broadcast_arrays((u - cam.cx)[None] / cam.fx, (v - cam.cy)[:, None] / cam.fy, 1.0), -1)
        object.__setattr__(self, "_rays", rays)

    def luminance(self, T_world_cam: Float[ndarray, "4 4"], t_s: float) -> Float[ndarray, "h w"]:
        """What every pixel sees of it."""
        texels = self._texels(T_world_cam, t_s)
        u, v = (_between_grid(texels[..., axis], self.camera.height, self.camera.width) for axis in (0, 1))
        return cv2.remap(self.picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP if self.wraps else cv2.BORDER_REFLECT_101)

    def way_px(self, T_world_cam: Float[ndarray, "q 4 4"], t_s: Float[ndarray, "q"]) -> Float[ndarray, "q-1"]:
        """How far the picture moves, at the most, between each two neighbouring times."""
        texels = np.stack([self._texels(T, float(t))[::4, ::4] for T, t in zip(T_world_cam, t_s, strict=True)])
        return np.linalg.norm(np.diff(texels, axis=0), axis=-1).max(axis=(1, 2))

    def _texels(self, T_world_cam: Float[ndarray, "4 4"], t_s: float) -> Texels:
        """Texels at the grid's points."""
        T = np.eye(4) if self.follows_camera else T_world_cam
        return self.placement(self._rays @ T[:3, :3].T, T[:3, 3]) - np.array(self.pan_px_s) * t_s


def _between_grid(values: Float[ndarray, "gh gw"], height: int, width: int) -> Float[ndarray, "h w"]:
    """Values at every pixel, bilinear between those at the grid's points; float32."""
    down, across = _line_weights(height, values.shape[0]), _line_weights(width, values.shape[1])
    return down @ values.astype(np.float32) @ across.T


@cache
def _line_weights(size: int, points: int) -> Float[ndarray, "n p"]:
    """Weights of the grid's points for every pixel of a line."""
    at = np.append(np.arange(0, size - 1, _GRID_PX), size - 1.0)
    return np.stack([np.interp(np.arange(size), at, unit_values) for unit_values in np.eye(points)], 1).astype(np.float32)
