"""The outlines of an object in a view, at thousands of poses: those of some hundred views from all around, moved to each pose."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import ContourConfig, TrackerConfig
from torchtrack.core.camera import Camera
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.relocalization.edge_search import pulled
from torchtrack.tracking.relocalization.view_sphere import moved_to, nearest_view, outlines_at, outlines_from, view_directions

_VIEWS = 500
_TOGETHER = 512
# What is known of a pose that is pulled onto events (rad, and diameters): hardly anything.
_UNKNOWN_RAD, _UNKNOWN_DIAMETERS = 0.5, 0.3


@dataclass(frozen=True)
class ViewedObject:
    """An object in a view, and what its outlines are taken with.

    Args:
        tracked: the object alone, seen by the view's camera.
        config: how contours are taken.
    """

    tracked: TrackedObjects
    config: TrackerConfig

    @classmethod
    def of_model(cls, model: ObjectModel, camera: Camera) -> "ViewedObject":
        """A model before a camera."""
        # Scored by the thousand, outlines of half as many points tell as much.
        config = TrackerConfig(contours=ContourConfig(max_edge_points=400))
        return cls(TrackedObjects([model], camera, config), config)

    @property
    def centre_obj(self) -> Float[Tensor, "3"]:
        """Its centre (m)."""
        return self.tracked.centre_obj[0]

    @property
    def intrinsics(self) -> Float[Tensor, "1 4"]:
        """``[fx, fy, cx, cy]`` of the view."""
        return self.tracked.intrinsics

    def placed(self, rotations: Float[Tensor, "n 3 3"], centres_cam: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4 4"]:
        """Poses with given rotations and places of the centre."""
        T = torch.eye(4).repeat(len(rotations), 1, 1)
        T[:, :3, :3] = rotations
        T[:, :3, 3] = centres_cam - T[:, :3, :3] @ self.centre_obj
        return T

    def by_view(self, rotations: Float[Tensor, "n 3 3"], depth_m: float) -> Iterator[tuple[Float[Tensor, "k 3 3"], Contours]]:
        """The outlines of the object straight ahead, rotated in many ways; some at a time, with their rotations."""
        towards = view_directions(_VIEWS).float()
        ahead = self.placed(rotations, torch.tensor([0.0, 0.0, depth_m]).expand(len(rotations), 3))
        views = outlines_from(self._prediction(ahead[:1]), towards, self.config)
        for T in ahead.split(_TOGETHER):
            yield T[:, :3, :3], moved_to(views, nearest_view(T, self.tracked.centre_obj, towards), T, self.intrinsics)

    def at(self, T_view_obj: Float[Tensor, "n 4 4"]) -> Contours:
        """The outlines at poses, as they are seen there."""
        return outlines_at(self._prediction(T_view_obj[:1]), T_view_obj, self.config)

    def pulled(self, T_view_obj: Float[Tensor, "n 4 4"], density: Float[Tensor, "h w"], reaches_px: tuple[float, ...]) -> Float[Tensor, "n 4 4"]:
        """Poses moved to where their outlines lie on events, by :func:`torchtrack.tracking.relocalization.edge_search.pulled`."""
        count, outlines = len(T_view_obj), self.at(T_view_obj)
        prediction = self._prediction(T_view_obj)
        sigmas = torch.tensor([_UNKNOWN_RAD] * 3 + [_UNKNOWN_DIAMETERS * float(self.tracked.diameter_m[0])] * 3, dtype=torch.float64)
        return pulled(prediction, prediction.T_cam_obj[:count], outlines, density[None], torch.diag(sigmas**2)[None], reaches_px)

    def _prediction(self, T_view_obj: Float[Tensor, "n 4 4"]) -> Prediction:
        count = len(T_view_obj)
        objects = self.tracked.objects.copies([0], count)
        nothing = torch.zeros(count, 6)
        return Prediction(objects, T_view_obj, torch.ones(count, dtype=torch.bool), nothing, torch.eye(12, dtype=torch.float64).repeat(count, 1, 1))
