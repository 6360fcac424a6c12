"""Whether a camera can see the objects where a run starts: what it cannot see cannot be tracked, and what it hardly sees is told."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import Camera, undistort
from torchtrack.core.lie import se3_inverse, transform_points
from torchtrack.errors import PoseError, TorchtrackWarning
from torchtrack.object_model import ObjectModel

# An object of fewer pixels has no contour; one of few is tracked badly.
_LEAST_PX, _SMALL_PX = 2.0, 10.0
# Of one that is larger than so many images, little of its contour is seen.
_LARGE_IMAGES = 4.0
_LEAST_SEEN = 0.25
_BORDER_POINTS = 33
_LOOKED_AT = 2000
_UNITS = "Is the translation in metres (translation_m), or in mm? And is the unit of the model right?"


def check_in_view(T_cam_obj: Float[Tensor, "b 4 4"], models: Sequence[ObjectModel], cameras: Sequence[Camera]) -> None:
    """Refuse objects that their cameras cannot see at the start, and warn of those that they hardly see.

    Args:
        T_cam_obj: initial poses.
        models: the objects.
        cameras: the one that each is seen by.

    Raises:
        PoseError: if an object is a pixel or two across, wholly outside the image, or around the camera.
    """
    views = {camera: _View.from_camera(camera) for camera in dict.fromkeys(cameras)}
    for T, model, camera in zip(T_cam_obj.detach().cpu().double(), models, cameras, strict=True):
        _check_object(T, model, views[camera])


@dataclass(frozen=True)
class _View:
    """What a camera sees, without its distortion.

    Args:
        camera: the camera.
        focal, principal: of both axes (px).
        low, high: the least and the largest ideal pixel (u, v).
    """

    camera: Camera
    focal: Float[Tensor, "2"]
    principal: Float[Tensor, "2"]
    low: Float[Tensor, "2"]
    high: Float[Tensor, "2"]

    @classmethod
    def from_camera(cls, camera: Camera) -> "_View":
        """By the border of the image."""
        u, v = np.linspace(-0.5, camera.width - 0.5, _BORDER_POINTS), np.linspace(-0.5, camera.height - 0.5, _BORDER_POINTS)
        sides = [(u, np.full_like(u, end)) for end in v[[0, -1]]] + [(np.full_like(v, end), v) for end in u[[0, -1]]]
        ideal = torch.from_numpy(undistort(np.concatenate([np.stack(side, 1) for side in sides]), camera))
        fx, fy, cx, cy = camera.intrinsics(torch.float64)
        return cls(camera, torch.stack([fx, fy]), torch.stack([cx, cy]), ideal.amin(0), ideal.amax(0))

    @property
    def size(self) -> str:
        """Width and height, for messages."""
        return f"{self.camera.width}x{self.camera.height}"

    def excludes(self, corners: Float[Tensor, "8 3"]) -> bool:
        """Whether a box lies beyond one side of the view; its corners may lie behind the camera."""
        low, high = (((end - self.principal) / self.focal) * corners[:, 2:] for end in (self.low, self.high))
        beyond = torch.cat([corners[:, :2] < low, corners[:, :2] > high, corners[:, 2:] <= 0], 1)
        return bool(beyond.all(0).any())

    def pixels(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
        """Ideal pixels of points before the camera."""
        return points[:, :2] / points[:, 2:] * self.focal + self.principal

    def share_within(self, points: Float[Tensor, "n 3"]) -> float:
        """Which share of some points it shows."""
        before = points[points[:, 2] > 0]
        pixels = self.pixels(before)
        return int(((pixels >= self.low) & (pixels <= self.high)).all(1).sum()) / max(len(points), 1)


def _check_object(T: Float[Tensor, "4 4"], model: ObjectModel, view: _View) -> None:
    middle, half = model.centre.double(), model.half_extent.double()
    corners = transform_points(T, middle + half * torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3))
    centre = transform_points(T, middle[None])
    away = f"{float(centre.norm()):.3g} m"
    if bool(((se3_inverse(T)[:3, 3] - middle).abs() < half).all()):
        raise PoseError(f"the camera is inside '{model.name}' at the start: the object's centre is {away} away. {_UNITS}")
    if float(centre[0, 2]) <= 0:
        raise PoseError(
            f"'{model.name}' is behind the camera at the start: its centre is at z = {float(centre[0, 2]):.3g} m. T_cam_obj maps points of the "
            "object to the camera's frame, whose z axis points from the camera to the scene; perhaps it is the inverse."
        )
    across_px = model.diameter_m * float(view.focal[0] / centre[0, 2])
    if across_px < _LEAST_PX:
        raise PoseError(f"'{model.name}' is {across_px:.2g} px across at {away} at the start: too small to be seen. {_UNITS}")
    if view.excludes(corners):
        u, v = view.pixels(centre)[0].tolist()
        raise PoseError(
            f"'{model.name}' is outside the image at the start: its centre is at pixel ({u:.0f}, {v:.0f}) of {view.size}, "
            f"{away} away. Check the initial pose (T_cam_obj: x right, y down, z forward), its time, and the camera."
        )
    if doubts := _doubts(T, model, view, across_px):
        warnings.warn(f"at the start '{model.name}' is {' and '.join(doubts)}. Check its initial pose, and units.", TorchtrackWarning, stacklevel=4)


def _doubts(T: Float[Tensor, "4 4"], model: ObjectModel, view: _View, across_px: float) -> list[str]:
    doubts = []
    if across_px < _SMALL_PX:
        doubts.append(f"{across_px:.2g} px across")
    if across_px > _LARGE_IMAGES * max(view.camera.width, view.camera.height):
        doubts.append(f"{across_px:.3g} px across, in an image of {view.size}")
    points_obj = model.extent_points
    seen = view.share_within(transform_points(T, points_obj[:: max(1, len(points_obj) // _LOOKED_AT)].double()))
    if seen < _LEAST_SEEN:
        doubts.append(f"mostly outside the image ({100 * seen:.0f} % of it within)")
    return doubts
