"""What a viewer shows of one window: of a run that goes on, or of one that was read back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.events import EventBatch
from torchtrack.run.sinks.poses import standard_deviations
from torchtrack.run.stepping import Step
from torchtrack.tracking.contours.points import Contours


@dataclass(frozen=True)
class VisibleContour:
    """The visible contour points of one object: ideal pixels, unit normals there, and where they are on the object (m)."""

    pixels: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]
    points_obj: Float[np.ndarray, "m 3"]

    @classmethod
    def of_object(cls, contours: Contours, index: int) -> "VisibleContour":
        """That of the object of this number."""
        seen = contours.mask[index].cpu()
        values = (contours.pixels, contours.normals, contours.points_obj)
        return cls(*(value[index].cpu().double()[seen].numpy() for value in values))


@dataclass(frozen=True)
class ObjectMoment:
    """One object at a window's end.

    Args:
        T_cam_obj: its pose (float64).
        status, quality: as the tracker judged it.
        std: standard deviations of rotation (°) and position (cm).
        contour: at the pose.
    """

    T_cam_obj: Float[Tensor, "4 4"]
    status: int
    quality: float
    std: tuple[float, float]
    contour: VisibleContour


@dataclass(frozen=True)
class Moment:
    """One window: its end, its events, its objects in their order, and times (ms) by what they are of."""

    t_us: int
    events: EventBatch
    objects: Sequence[ObjectMoment]
    times_ms: Mapping[str, float] = field(default_factory=dict)


def moment_of(step: Step, times_ms: Mapping[str, float]) -> Moment:
    """What a step of a run shows."""
    result = step.result
    poses: Tensor = result.T_cam_obj.to("cpu", torch.float64)
    stds = standard_deviations(result.covariance.cpu(), poses).tolist()
    judged = zip(result.status.tolist(), result.quality.tolist(), stds, strict=True)
    objects = [
        ObjectMoment(poses[index], status, quality, (rotation_deg, position_cm), VisibleContour.of_object(result.contours, index))
        for index, (status, quality, (rotation_deg, position_cm)) in enumerate(judged)
    ]
    return Moment(step.window.t_end_us, step.window.events, objects, times_ms)
