"""What each object's pose is worth, and where it goes on from there: :mod:`torchtrack.tracking.update`, object by object."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import SolutionArrays, as_arrays
from torchtrack.backends.numba.compiler import Array, for_numbers, kernel
from torchtrack.backends.numba.filtering import inverse
from torchtrack.backends.numba.geometry import centre_of, is_finite
from torchtrack.backends.numba.parameters import ConclusionSettings
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking import update
from torchtrack.tracking.motion import model
from torchtrack.tracking.motion.model import MotionState
from torchtrack.tracking.relocalization.lost_objects import Relocalized
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation import verdict
from torchtrack.tracking.validation.verdict import Limits, Measured, References, Verdict

_UNKNOWNS = 12
# The rules, for one object: the same source as PyTorch runs.
_RULES = for_numbers(
    verdict.needed_ratio, verdict.partly_hidden, verdict.trust, verdict.judge, verdict.smeared, verdict.verdict,
    verdict.seen_well,
    verdict.confirmations, verdict.remembered,
)  # fmt: skip
_verdict, _remembered = _RULES["verdict"], _RULES["remembered"]


class Before(NamedTuple):
    """Objects before the window: poses ``[b, 4, 4]``, how long it is, centres, and diameters."""

    T_cam_obj: Array
    dt_s: Array
    centre_obj: Array
    diameter_m: Array


class Predicted(NamedTuple):
    """The prediction: ``[b, 4, 4]``, ``[b]``, ``[b, 6]``, and ``[b, 12, 12]``."""

    T_cam_obj: Array
    usable: Array
    velocity: Array
    covariance: Array


class Fits(NamedTuple):
    """What is known of the fits, in the order of :class:`Measured`: numbers ``[7, b]``, counts ``[2, b]``, and flags ``[2, b]``."""

    measured: Array
    counts: Array
    flags: Array


class After(NamedTuple):
    """Objects after the window.

    Args:
        T_cam_obj, velocity, covariance: ``[b, 4, 4]``, ``[b, 6]``, and ``[b, 12, 12]``.
        left, status: the covariance of poses, ``[b, 6, 6]``, and ``[b]``.
        references, T_last_validated: ``[6, b]``, in the order of :class:`References`, and ``[b, 4, 4]``; when given, those before the window.
    """

    T_cam_obj: Array
    velocity: Array
    covariance: Array
    left: Array
    status: Array
    references: Array
    T_last_validated: Array


@kernel()
def conclude(before: Before, predicted: Predicted, solved: SolutionArrays, fits: Fits, settings: ConclusionSettings, after: After) -> None:
    """Judge every object, and go on as predicted where it failed; what is known after the window is filled."""
    before, predicted, solved, after = Before(*before), Predicted(*predicted), SolutionArrays(*solved), After(*after)
    estimated, centre, limits, (all_measured, counts, flags) = np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(3), settings.limits, fits
    for b in range(len(predicted.usable)):
        m, r, dt, offset = all_measured[:, b], after.references[:, b], before.dt_s[b], solved.offset[b]
        rotated, moved, usable = _length(offset[:3]), _length(offset[3:6]) / before.diameter_m[b], predicted.usable[b]
        of_fit = Measured(m[0], m[1], m[2], m[3], m[4], m[5], m[6], rotated, moved, counts[0, b], counts[1, b], flags[0, b], usable, flags[1, b])
        known = References(r[0], r[1], r[2], r[3], r[4], r[5])
        judged = _verdict(of_fit, known, limits)
        after.status[b], T_cam_obj = judged.status, after.T_cam_obj[b]
        _orthonormalise(predicted.T_cam_obj[b] if judged.failed else solved.T_cam_obj[b], T_cam_obj)
        if judged.held or (judged.failed and not usable):
            T_cam_obj[:] = before.T_cam_obj[b]
        inverse(solved.hessian[b], estimated)
        estimated *= settings.observation_px**2
        after.covariance[b], after.velocity[b] = predicted.covariance[b], predicted.velocity[b]
        _update(judged, np.exp(-dt / settings.coast_s), offset, estimated, after.velocity[b], after.covariance[b])
        centre_of(T_cam_obj, before.centre_obj[b], centre)
        _to_left(after.covariance[b], centre, after.left[b])
        r[0], r[1], r[2], r[3], r[4], r[5] = _remembered(known, of_fit, judged, dt, limits)
        if judged.is_certain:
            after.T_last_validated[b] = T_cam_obj


@kernel()
def _length(vector: Array) -> float:
    """Length of three numbers."""
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@kernel()
def _orthonormalise(T: Array, exact: Array) -> None:
    """A pose whose rotation is exact again: :func:`torchtrack.core.lie.orthonormalise`."""
    square = np.zeros((3, 3))
    for j in range(3):
        for k in range(3):
            for m in range(3):
                square[j, k] += np.float64(T[m, j]) * np.float64(T[m, k])
    exact[:] = T
    for j in range(3):
        for k in range(3):
            exact[j, k] = 1.5 * T[j, k] - 0.5 * (T[j, 0] * square[0, k] + T[j, 1] * square[1, k] + T[j, 2] * square[2, k])


@kernel()
def _update(judged: Verdict, coasting: float, offset: Array, estimated: Array, velocity: Array, covariance: Array) -> None:
    """Bring velocity and covariance up from what was predicted: as estimated, as far as that is to be trusted; none where an object is held.

    Args:
        coasting: how much of its velocity an object keeps that failed.
    """
    trusted = judged.trusted * np.isfinite(estimated.sum())
    if trusted > 0:
        for j in range(12):
            for k in range(12):
                covariance[j, k] = estimated[j, k] + (1.0 - trusted) * (covariance[j, k] - estimated[j, k])
    kept, dropped = coasting if judged.failed else 1.0, np.empty(6)
    for k in range(6):
        moving = velocity[k] + trusted * offset[6 + k]
        velocity[k] = 0.0 if judged.held else kept * moving
        dropped[k] = moving - velocity[k]
    if judged.held:
        for j in range(6):
            for k in range(6):
                covariance[6 + j, 6 + k] += dropped[j] * dropped[k]


@kernel()
def _to_left(covariance: Array, centre_cam: Array, left: Array) -> None:
    """Covariance of the left perturbation of a pose: :func:`torchtrack.core.pose_covariance.left_covariance`."""
    left[:] = covariance[:6, :6]
    if not is_finite(left):
        return
    x, y, z = centre_cam
    # Rows and columns of translations take on the centre × those of rotations.
    for k in range(6):
        a, b, c = left[0, k], left[1, k], left[2, k]
        left[3, k] += y * c - z * b
        left[4, k] += z * a - x * c
        left[5, k] += x * b - y * a
    for k in range(6):
        a, b, c = left[k, 0], left[k, 1], left[k, 2]
        left[k, 3] += y * c - z * b
        left[k, 4] += z * a - x * c
        left[k, 5] += x * b - y * a


@accelerates(update.judged_objects, supports=lambda state, located, dt_s, config: config.solver.prior)
def judged_objects_numba(state: TrackerState, located: Relocalized, dt_s: Float[Tensor, "b"], config: TrackerConfig) -> update.Judgement:
    """Object by object."""
    prediction, scored = located.prediction, located.scored
    objects, solution, batch, health = prediction.objects, scored.fit.solution, len(dt_s), state.health
    ratios = scored.explained_ratio, scored.score, scored.inlier_ratio, scored.reference_inlier_ratio, scored.texture_agreement
    measured = torch.stack([*ratios, scored.visible_ratio, located.gate_scale])
    counts = torch.stack([scored.count, scored.fit.matches.near.sum(-1)])
    flags = torch.stack([~scored.measured_ratio.isnan(), scored.is_relocalized])
    remembered = torch.stack(health.references)
    T_last_validated = health.T_last_validated.clone(memory_format=torch.contiguous_format)
    T_cam_obj, covariance, left = (T_last_validated.new_empty(batch, size, size) for size in (4, 12, 6))
    velocity, status = dt_s.new_empty(batch, 6), scored.count.new_empty(batch)
    conclude(
        as_arrays(state.T_cam_obj, dt_s, objects.centre_obj, objects.diameter_m),
        as_arrays(prediction.T_cam_obj, prediction.usable, prediction.velocity, prediction.covariance),
        as_arrays(solution.T_cam_obj, solution.from_prior, solution.gradient, solution.hessian),
        as_arrays(measured, counts, flags),
        filled(ConclusionSettings, config.solver, model, limits=Limits.from_config(config)),
        as_arrays(T_cam_obj, velocity, covariance, left, status, remembered, T_last_validated),
    )
    health = replace(health, **References(*remembered.unbind())._asdict(), T_last_validated=T_last_validated)
    return MotionState(T_cam_obj, velocity, covariance), health, left, status
