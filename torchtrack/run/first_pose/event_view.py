"""What is shown of the start: the events as an image, and the contours of the object at a pose, both in ideal pixels."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.camera import MIN_DEPTH_M, Camera
from torchtrack.core.lie import transform_points
from torchtrack.object_model import ObjectModel
from torchtrack.run.first_pose.start import Start
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.viz.contour_lines import contour_links

# Grey of the last event that is shown, and how much brighter the first is.
_DARKEST, _BRIGHTER = 60, 195


def event_image(start: Start, shown_us: int) -> UInt8[ndarray, "h w"]:
    """The events of some time after the start: those right at the start are the brightest, as the pose is of then."""
    height, width = start.camera.height, start.camera.width
    image = np.zeros((height, width), np.uint8)
    count = int(torch.searchsorted(start.events.t_us, start.at_us + shown_us, right=True))
    u, v = start.pixels[:count].round().long().numpy().T
    age = (start.events.t_us[:count] - start.at_us).numpy() / shown_us
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    np.maximum.at(image, (v[inside], u[inside]), (_DARKEST + _BRIGHTER * (1 - age[inside])).round().astype(np.uint8))
    return image


@dataclass(frozen=True)
class ContourView:
    """Draws the contours of an object, as the tracker would use them.

    Args:
        model: of the object.
        tracked: the object alone, seen by its camera.
    """

    model: ObjectModel
    tracked: TrackedObjects

    @classmethod
    def of_model(cls, model: ObjectModel, camera: Camera) -> "ContourView":
        """Of a model before a camera."""
        return cls(model, TrackedObjects([model], camera, TrackerConfig()))

    def lines(self, T_cam_obj: Float[Tensor, "4 4"]) -> Float[ndarray, "l 2 2"]:
        """The ends of lines along the visible contours at a pose (ideal pixels); none where the object reaches behind the camera."""
        if not self.is_ahead(T_cam_obj):
            return np.zeros((0, 2, 2))
        with torch.inference_mode():
            contours = self.tracked.objects.contours(T_cam_obj[None].float(), self.tracked.config.contours)
        seen = contours.mask[0]
        pixels, normals = (values[0][seen].double().numpy() for values in (contours.pixels, contours.normals))
        lines: Float[ndarray, "l 2 2"] = pixels[contour_links(pixels, normals)]
        return lines

    def is_ahead(self, T_cam_obj: Float[Tensor, "4 4"]) -> bool:
        """Whether all of the object is before the camera."""
        depth_m = transform_points(T_cam_obj.double(), self.model.extent_points.double())[:, 2]
        return float(depth_m.min()) > MIN_DEPTH_M
