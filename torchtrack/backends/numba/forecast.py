"""Where objects are expected at a window's end: :mod:`torchtrack.tracking.motion.predict`, object by object."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.geometry import depth_of, is_finite, turn
from torchtrack.backends.numba.parameters import ForecastSettings
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion import model, predict
from torchtrack.tracking.motion.model import MotionState
from torchtrack.tracking.motion.prediction import MAX_DEPTH_M, Prediction


@kernel()
def forecast(
    T_cam_obj: Array,
    velocity: Array,
    covariance: Array,
    dt_s: Array,
    centre_obj: Array,
    diameter_m: Array,
    far_pose: Array,
    settings: ForecastSettings,
    T_prior: Array,
    usable: Array,
    new_velocity: Array,
    predicted: Array,
) -> None:
    """Predict each object's pose, velocity and covariance.

    Args:
        T_cam_obj, velocity, covariance: of the state: ``[b, 4, 4]``, ``[b, 6]``, ``[b, 12, 12]``.
        far_pose: ``[b, 4, 4]``, in the place of a pose that is not usable.
        T_prior, usable, new_velocity, predicted: ``[b, 4, 4]``, ``[b]``, ``[b, 6]`` and ``[b, 12, 12]``; filled.
    """
    before, moved, start = np.empty(6), np.empty(6), np.empty((12, 12))
    for b in range(len(T_cam_obj)):
        dt = np.float64(dt_s[b])
        start[:] = covariance[b]
        _expected_velocity(velocity[b], dt, settings, before, start)
        rotation_sigma, move_sigma = _acceleration_sigma(before, diameter_m[b], settings)
        _predict(start, rotation_sigma, move_sigma, dt, diameter_m[b], settings.most_uncertain, predicted[b])
        for k in range(6):
            new_velocity[b, k], moved[k] = before[k], before[k] * dt
        usable[b] = _step(T_cam_obj[b], centre_obj[b], moved, settings.least_depth_m, settings.most_depth_m, T_prior[b])
        if not usable[b]:
            T_prior[b], new_velocity[b] = far_pose[b], 0.0


@kernel()
def _expected_velocity(velocity: Array, dt: float, settings: ForecastSettings, before: Array, covariance: Array) -> None:
    """Velocity to be expected: turns die away; none at all where an object is expected to stay, which makes it uncertain."""
    kept = np.exp(-dt / settings.turn_s) if settings.turn_s > 0 else 1.0
    for k in range(6):
        before[k] = velocity[k] * (kept if k < 3 else 1.0)
    if settings.holds:
        for j in range(6):
            for k in range(6):
                covariance[6 + j, 6 + k] += before[j] * before[k]
        before[:] = 0.0


@kernel()
def _acceleration_sigma(velocity: Array, diameter_m: float, settings: ForecastSettings) -> tuple[float, float]:
    """Standard deviations of angular acceleration and of that of the centre: :func:`torchtrack.tracking.motion.model.acceleration_sigma`."""
    turning = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    moving = np.sqrt(velocity[3] ** 2 + velocity[4] ** 2 + velocity[5] ** 2)
    of_rim = settings.acceleration_rate_hz * (moving + 0.5 * diameter_m * turning) + settings.acceleration_floor_m_s2
    return 2.0 * of_rim / diameter_m, of_rim


@kernel()
def _predict(
    covariance: Array, rotation_sigma: float, move_sigma: float, dt: float, diameter_m: float, most_uncertain: float, predicted: Array
) -> None:
    """Covariance of pose and velocity after a while: :func:`torchtrack.tracking.motion.model.predict_covariance`.

    Args:
        covariance: ``[12, 12]``.
        rotation_sigma, move_sigma: standard deviations of the acceleration.
        most_uncertain: what would be less certain than this (rad, and diameters) is left as it is.
        predicted: filled.
    """
    P, new = covariance, predicted
    for j in range(6):
        for k in range(6):
            both = P[j, 6 + k] + dt * P[6 + j, 6 + k]
            new[j, k] = P[j, k] + dt * P[6 + j, k] + dt * both
            new[j, 6 + k], new[6 + j, k] = both, P[6 + j, k] + dt * P[6 + j, 6 + k]
            new[6 + j, 6 + k] = P[6 + j, 6 + k]
        # An acceleration adds half its square of the time to the pose, and its time to the velocity.
        sigma = rotation_sigma if j < 3 else move_sigma
        way, gain = 0.5 * dt * dt * sigma, dt * sigma
        new[j, j] += way * way
        new[j, 6 + j] += way * gain
        new[6 + j, j] += way * gain
        new[6 + j, 6 + j] += gain * gain
    for j in range(6):
        if np.sqrt(new[j, j]) > most_uncertain * (1.0 if j < 3 else diameter_m):
            new[:] = P
            break


@kernel()
def _step(T_cam_obj: Array, centre_obj: Array, moved: Array, least_depth_m: float, most_depth_m: float, stepped: Array) -> bool:
    """Move a pose a little, about the object's centre; whether it is one before the camera."""
    rotation = np.empty((3, 3))
    turn(T_cam_obj[:3, :3], moved, rotation)
    for j in range(3):
        stepped[j, 3] = T_cam_obj[j, 3] + moved[3 + j]
        for k in range(3):
            stepped[j, 3] += (T_cam_obj[j, k] - rotation[j, k]) * centre_obj[k]
            stepped[j, k] = rotation[j, k]
    stepped[3] = T_cam_obj[3]
    return is_finite(stepped) and least_depth_m < depth_of(stepped, centre_obj) < most_depth_m


@accelerates(predict.forecast)
def forecast_numba(
    state: MotionState,
    dt_s: Float[Tensor, "b"],
    objects: ObjectBatch,
    far_pose: Float[Tensor, "b 4 4"],
    config: TrackerConfig,
) -> Prediction:
    """Object by object."""
    batch = len(dt_s)
    T_prior, usable = far_pose.new_empty(batch, 4, 4), torch.empty(batch, dtype=torch.bool)
    velocity, covariance = far_pose.new_empty(batch, 6), state.covariance.new_empty(batch, 12, 12)
    known = as_arrays(state.T_cam_obj, state.velocity, state.covariance, dt_s)
    of_objects = as_arrays(objects.centre_obj, objects.diameter_m, far_pose)
    settings = filled(
        ForecastSettings,
        config.motion,
        model,
        holds=config.motion.model == "hold",
        turn_s=model.TURN_S if config.uses(Component.TURNS_FADE) else 0.0,
        least_depth_m=MIN_DEPTH_M,
        most_depth_m=MAX_DEPTH_M,
    )
    forecast(*known, *of_objects, settings, *as_arrays(T_prior, usable, velocity, covariance))
    return Prediction(objects, T_prior, usable, velocity, covariance)
