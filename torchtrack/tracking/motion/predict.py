"""The prediction of a window: where objects are expected at its end, how they have come to move by then, and how certain that is."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.parameters import ForecastSettings
from torchtrack.config.tracker import MotionConfig, TrackerConfig
from torchtrack.core import dispatch, lie
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.model import (
    MOST_UNCERTAIN,
    STEEPNESS,
    Acceleration,
    expected_velocity,
    next_acceleration,
    predict_covariance,
    with_dropped,
    without_spin,
)
from torchtrack.tracking.motion.prediction import MAX_DEPTH_M, Prediction, before_camera
from torchtrack.tracking.state import TrackerState


def forecast(
    state: TrackerState,
    dt_s: Float[Tensor, "b"],
    objects: ObjectBatch,
    axes_obj: Float[Tensor, "b 3"] | None,
    far_pose: Float[Tensor, "b 4 4"],
    config: TrackerConfig,
) -> Prediction:
    """Predicted pose and motion of each object, and how certain they are.

    Args:
        state: where the window begins.
        dt_s: length of the window.
        objects: the objects, as they are known.
        axes_obj: unit axes of surfaces of revolution, zero of other objects; none at all where no object is one.
        far_pose: poses in the place of those that are not usable.
    """
    axes_obj = axes_obj if config.motion.spin_fades else None
    if dispatch.apply_to(dt_s):
        return _by_kernel(state, dt_s, objects, axes_obj, far_pose, config)
    motion, covariance = config.motion, state.covariance
    velocity = expected_velocity(state.velocity, dt_s, motion)
    if motion.model == "hold":
        velocity, covariance = torch.zeros_like(velocity), with_dropped(covariance, velocity)
    if axes_obj is not None:
        axes_cam = (state.T_cam_obj[:, :3, :3].to(velocity.dtype) @ axes_obj[..., None])[..., 0]
        velocity, covariance = without_spin(velocity, covariance, axes_cam, dt_s, motion)
    before, px_per_m = velocity.detach(), objects.px_per_m(state.T_cam_obj.detach().to(velocity.dtype)).detach()
    covariance = predict_covariance(covariance.detach(), before, dt_s, objects.diameter_m, motion)
    acceleration = next_acceleration(state.acceleration, before, covariance, dt_s, objects.diameter_m, px_per_m, motion)
    gained = acceleration.expected * dt_s[:, None]
    moved, velocity = torch.add(velocity, gained, alpha=0.5) * dt_s[:, None], velocity + gained
    T_prior = lie.step_about(state.T_cam_obj.to(velocity.dtype), moved, objects.centre_obj)
    T_prior, usable = before_camera(T_prior, objects.centre_obj, far_pose)
    told = acceleration if config.solver.prior else None
    return Prediction(objects, T_prior, usable, torch.where(usable[:, None], velocity, 0), covariance, told)


def _by_kernel(
    state: TrackerState, dt_s: Tensor, objects: ObjectBatch, axes_obj: Tensor | None, far_pose: Tensor, config: TrackerConfig
) -> Prediction:
    """:func:`forecast`, object by object."""
    # Not at the top: Numba is an extra.
    from torchtrack.backends.numba import forecast as kernels

    batch, axes = len(dt_s), far_pose.new_empty(0, 3) if axes_obj is None else axes_obj
    T_prior, usable = far_pose.new_empty(batch, 4, 4), torch.empty(batch, dtype=torch.bool)
    told, covariance = far_pose.new_empty(kernels.TOLD, batch, 6), state.covariance.new_empty(batch, 12, 12)
    known = as_arrays(state.T_cam_obj, state.velocity, state.acceleration, state.covariance, dt_s)
    of_objects = as_arrays(objects.centre_obj, objects.diameter_m, objects.intrinsics, axes, far_pose)
    kernels.forecast(*known, *of_objects, _settings(config.motion), *as_arrays(T_prior, usable, told, covariance))
    velocity, *of_acceleration = told.unbind()
    return Prediction(objects, T_prior, usable, velocity, covariance, Acceleration(*of_acceleration) if config.solver.prior else None)


def _settings(config: MotionConfig) -> ForecastSettings:
    """What a kernel goes by that predicts as :func:`forecast` does."""
    return ForecastSettings(
        holds=config.model == "hold",
        turn_s=config.turn_s,
        coast_s=config.coast_s,
        acceleration_rate_hz=config.acceleration_rate_hz,
        acceleration_floor_m_s2=config.acceleration_floor_m_s2,
        acceleration_px=config.acceleration_px,
        acceleration_s=config.acceleration_s,
        most_uncertain=MOST_UNCERTAIN,
        steepness=STEEPNESS,
        least_depth_m=MIN_DEPTH_M,
        most_depth_m=MAX_DEPTH_M,
    )
