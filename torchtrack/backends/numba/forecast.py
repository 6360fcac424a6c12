"""Where objects are expected at a window's end: :mod:`torchtrack.tracking.motion.predict`, object by object."""

from typing import NamedTuple

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


class Motion(NamedTuple):
    """Poses, velocities and covariances: ``[b, 4, 4]``, ``[b, 6]``, and ``[b, 12, 12]``."""

    T_cam_obj: Array
    velocity: Array
    covariance: Array


class Extents(NamedTuple):
    """Centres and diameters of objects, and poses in the place of those that are not usable, ``[b, 4, 4]``."""

    centre_obj: Array
    diameter_m: Array
    far_pose: Array


@kernel()
def forecast(before: Motion, dt_s: Array, objects: Extents, settings: ForecastSettings, after: Motion, usable: Array) -> None:
    """Predict each object's pose, velocity and covariance.

    Args:
        after, usable: filled; ``[b]``.
    """
    before, after, objects = Motion(*before), Motion(*after), Extents(*objects)
    velocity, moved, start = np.empty(6), np.empty(6), np.empty((12, 12))
    for b in range(len(usable)):
        dt, diameter_m = np.float64(dt_s[b]), objects.diameter_m[b]
        start[:] = before.covariance[b]
        _expected_velocity(before.velocity[b], dt, settings, velocity, start)
        sigmas = _acceleration_sigma(velocity, diameter_m, settings)
        _predict(start, sigmas, dt, (settings.most_uncertain, settings.most_uncertain * diameter_m), after.covariance[b])
        for k in range(6):
            after.velocity[b, k], moved[k] = velocity[k], velocity[k] * dt
        usable[b] = _step(before.T_cam_obj[b], objects.centre_obj[b], moved, settings.least_depth_m, settings.most_depth_m, after.T_cam_obj[b])
        if not usable[b]:
            after.T_cam_obj[b], after.velocity[b] = objects.far_pose[b], 0.0


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
def _predict(covariance: Array, sigmas: tuple[float, float], dt: float, most: tuple[float, float], predicted: Array) -> None:
    """Covariance of pose and velocity after a while: :func:`torchtrack.tracking.motion.model.predict_covariance`.

    Args:
        covariance: ``[12, 12]``.
        sigmas: standard deviations of the acceleration, in rotation and in translation.
        most: what would be less certain than this (rad, m) is left as it is.
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
        sigma = sigmas[0] if j < 3 else sigmas[1]
        way, gain = 0.5 * dt * dt * sigma, dt * sigma
        new[j, j] += way * way
        new[j, 6 + j] += way * gain
        new[6 + j, j] += way * gain
        new[6 + j, 6 + j] += gain * gain
    for j in range(6):
        if np.sqrt(new[j, j]) > (most[0] if j < 3 else most[1]):
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
    before, extents = as_arrays(state.T_cam_obj, state.velocity, state.covariance), (objects.centre_obj, objects.diameter_m, far_pose)
    settings = filled(
        ForecastSettings,
        config.motion,
        model,
        holds=config.motion.model == "hold",
        turn_s=model.TURN_S if config.uses(Component.TURNS_FADE) else 0.0,
        least_depth_m=MIN_DEPTH_M,
        most_depth_m=MAX_DEPTH_M,
    )
    after = as_arrays(T_prior, velocity, covariance)
    forecast(before, *as_arrays(dt_s), as_arrays(*extents), settings, after, usable.numpy())
    return Prediction(objects, T_prior, usable, velocity, covariance)
