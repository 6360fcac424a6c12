"""The prediction of a window: where objects are expected at its end, how they have come to move by then, and how certain that is."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import lie
from torchtrack.core.dispatch import accelerable
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.model import MotionState, expected_velocity, predict_covariance, with_dropped
from torchtrack.tracking.motion.prediction import Prediction, before_camera


@accelerable
def forecast(
    state: MotionState,
    dt_s: Float[Tensor, "b"],
    objects: ObjectBatch,
    far_pose: Float[Tensor, "b 4 4"],
    config: TrackerConfig,
) -> Prediction:
    """Predicted pose and motion of each object, and how certain they are.

    Args:
        state: where the window begins.
        dt_s: length of the window.
        objects: the objects, as they are known.
        far_pose: poses in the place of those that are not usable.
    """
    motion, covariance = config.motion, state.covariance
    velocity = expected_velocity(state.velocity, dt_s) if config.uses(Component.TURNS_FADE) else state.velocity
    if motion.model == "hold":
        velocity, covariance = torch.zeros_like(velocity), with_dropped(covariance, velocity)
    covariance = predict_covariance(covariance.detach(), velocity.detach(), dt_s, objects.diameter_m, motion)
    T_prior = lie.step_about(state.T_cam_obj.to(velocity.dtype), velocity * dt_s[:, None], objects.centre_obj)
    T_prior, usable = before_camera(T_prior, objects.centre_obj, far_pose)
    return Prediction(objects, T_prior, usable, torch.where(usable[:, None], velocity, 0), covariance)
