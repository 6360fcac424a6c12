"""A small view of an object: a camera that looks straight at its box, with so few pixels that a search is cheap.

The view is the real camera, rotated towards the middle of the box and coarser. An object of any size in the image takes about as many pixels
in it, so that what is far and near in a search is the same for all.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import Camera
from torchtrack.run.first_pose.start import Box

# Side of the view, and the longer side of the box in it (px).
SIDE_PX, BOX_PX = 192, 108.0


@dataclass(frozen=True)
class SearchView:
    """A rotated and coarser camera.

    Args:
        camera: the coarser one, without a lens.
        rotation: from the axes of the real camera to its own (float64).
        intrinsics: ``[fx, fy, cx, cy]`` of the real camera (float64).
        box: what it looks at, in its own pixels.
    """

    camera: Camera
    rotation: Float[Tensor, "3 3"]
    intrinsics: Float[Tensor, "4"]
    box: Box

    @classmethod
    def of_box(cls, camera: Camera, box: Box) -> "SearchView":
        """The view of a box in the ideal pixels of a camera."""
        intrinsics = camera.intrinsics(torch.float64)
        forward = _rays(box.centre[None].double(), intrinsics)[0]
        forward = forward / forward.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        coarser = BOX_PX / float(box.size.max())
        middle = (SIDE_PX - 1) / 2
        # Off the real camera's axis a pixel is seen under a smaller angle.
        focal = camera.fx * coarser / float(forward[2])
        own = Camera(fx=focal, fy=focal, cx=middle, cy=middle, width=SIDE_PX, height=SIDE_PX)
        view = cls(own, rotation, intrinsics, box)
        corners = torch.tensor([[u, v] for u in (box.u0, box.u1) for v in (box.v0, box.v1)])
        return cls(own, rotation, intrinsics, Box.around(view.pixels(corners)))

    def pixels(self, ideal_pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Where the view has what the camera sees at some ideal pixels; far outside for what is not before it."""
        rays = _rays(ideal_pixels.double(), self.intrinsics) @ self.rotation.mT
        own = self.camera.intrinsics(torch.float64)
        # Lenses see no more than so much to the side of the box.
        return (rays[:, :2] / rays[:, 2:].clamp(min=0.05) * own[:2] + own[2:]).float()

    def to_camera(self, T_view_obj: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
        """Poses in the real camera's frame (float64)."""
        return self._to_view().mT @ T_view_obj.double()

    def from_camera(self, T_cam_obj: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
        """Poses in the view's frame (float64)."""
        return self._to_view() @ T_cam_obj.double()

    def _to_view(self) -> Float[Tensor, "4 4"]:
        # A rotation alone: its inverse is its transpose.
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = self.rotation
        return T


def _rays(pixels: Float[Tensor, "n 2"], intrinsics: Float[Tensor, "4"]) -> Float[Tensor, "n 3"]:
    return torch.nn.functional.pad((pixels - intrinsics[2:]) / intrinsics[:2], (0, 1), value=1.0)
