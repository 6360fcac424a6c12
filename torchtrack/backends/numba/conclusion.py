"""What each object's pose is worth, and where it goes on from there: :mod:`torchtrack.tracking.update`, object by object."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, for_numbers, kernel
from torchtrack.backends.numba.filtering import inverse
from torchtrack.backends.numba.geometry import centre_of, is_finite
from torchtrack.backends.numba.parameters import CorrectionSettings
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking import update
from torchtrack.tracking.motion import model
from torchtrack.tracking.motion.model import MotionState
from torchtrack.tracking.relocalization.lost_objects import Relocalized
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation import verdict
from torchtrack.tracking.validation.measures import visible_ratio
from torchtrack.tracking.validation.verdict import Limits, Measured, References

_UNKNOWNS = 12
# The rules, for one object: the same source as PyTorch runs.
_RULES = for_numbers(
    verdict.needed_ratio, verdict.partly_hidden, verdict.trust, verdict.judge, verdict.smeared, verdict.verdict,
    verdict.seen_well,
    verdict.confirmations, verdict.remembered,
)  # fmt: skip
_verdict, _remembered = _RULES["verdict"], _RULES["remembered"]


@kernel()
def conclude(
    T_before: Array,
    T_prior: Array,
    usable: Array,
    velocity: Array,
    covariance: Array,
    T_estimated: Array,
    offset: Array,
    hessian: Array,
    counts: Array,
    flags: Array,
    measured: Array,
    dt_s: Array,
    centre_obj: Array,
    diameter_m: Array,
    limits: Limits,
    settings: CorrectionSettings,
    remembered: Array,
    T_last_validated: Array,
    T_cam_obj: Array,
    new_velocity: Array,
    posterior: Array,
    left: Array,
    status: Array,
) -> None:
    """Judge every object, and go on as predicted where it failed.

    Args:
        T_before: poses before the window, ``[b, 4, 4]``.
        T_prior, usable, velocity, covariance: of the prediction.
        T_estimated, offset, hessian: of the solution: ``[b, 4, 4]``, ``[b, 12]``, ``[b, 12, 12]``.
        counts, flags, measured: ``[2, b]``, ``[2, b]`` and ``[7, b]``: what is known of the fits, in the order of :class:`Measured`.
        remembered, T_last_validated: ``[6, b]``, in the order of :class:`References`, and ``[b, 4, 4]`` before the window; changed to those after it.
        T_cam_obj, new_velocity, posterior, left, status: after the window, ``left`` being the covariance of poses; filled.
    """
    inverses, centre = np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(3)
    for b in range(len(usable)):
        m, r = measured[:, b], remembered[:, b]
        rotated, moved = _length(offset[b, :3]), _length(offset[b, 3:6]) / diameter_m[b]
        of_fit = Measured(m[0], m[1], m[2], m[3], m[4], m[5], m[6], rotated, moved, counts[0, b], counts[1, b], flags[0, b], usable[b], flags[1, b])
        known = References(r[0], r[1], r[2], r[3], r[4], r[5])
        judged = _verdict(of_fit, known, limits)
        status[b] = judged.status
        _orthonormalise(T_prior[b] if judged.failed else T_estimated[b], T_cam_obj[b])
        if judged.held or (judged.failed and not usable[b]):
            T_cam_obj[b] = T_before[b]
        inverse(hessian[b], inverses)
        of_prediction = velocity[b], covariance[b]
        _update(judged.trusted, judged.failed, judged.held, dt_s[b], of_prediction, offset[b], inverses, settings, new_velocity[b], posterior[b])
        centre_of(T_cam_obj[b], centre_obj[b], centre)
        _to_left(posterior[b], centre, left[b])
        r[0], r[1], r[2], r[3], r[4], r[5] = _remembered(known, of_fit, judged, dt_s[b], limits)
        if judged.is_certain:
            T_last_validated[b] = T_cam_obj[b]


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
def _update(
    trusted: float,
    failed: bool,
    held: bool,
    dt: float,
    of_prediction: tuple[Array, Array],
    offset: Array,
    inverses: Array,
    settings: CorrectionSettings,
    new_velocity: Array,
    posterior: Array,
) -> None:
    """Velocity and covariance after a window: as estimated, as far as that is to be trusted; none where an object is ``held``."""
    velocity, predicted = of_prediction
    variance, total = settings.observation_px**2, 0.0
    for j in range(12):
        for k in range(12):
            total += variance * inverses[j, k]
    trusted *= np.isfinite(total)
    for j in range(12):
        for k in range(12):
            estimated = variance * inverses[j, k]
            posterior[j, k] = estimated + (1.0 - trusted) * (predicted[j, k] - estimated) if trusted > 0 else predicted[j, k]
    kept = np.exp(-dt / settings.coast_s) if failed else 1.0
    dropped = np.empty(6)
    for k in range(6):
        moving = velocity[k] + trusted * offset[6 + k]
        new_velocity[k] = 0.0 if held else kept * moving
        dropped[k] = moving - new_velocity[k]
    if held:
        for j in range(6):
            for k in range(6):
                posterior[6 + j, 6 + k] += dropped[j] * dropped[k]


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
    in_view = visible_ratio(scored.fit.contours, objects.image_sizes)
    ratios = scored.explained_ratio, scored.score, scored.inlier_ratio, scored.reference_inlier_ratio, scored.texture_agreement, in_view
    measured = torch.stack([*ratios, located.gate_scale])
    counts = torch.stack([scored.count, scored.fit.matches.near.sum(-1)])
    flags = torch.stack([~scored.measured_ratio.isnan(), scored.is_relocalized])
    remembered = torch.stack(health.references)
    T_last_validated = health.T_last_validated.clone(memory_format=torch.contiguous_format)
    T_cam_obj, covariance, left = (T_last_validated.new_empty(batch, size, size) for size in (4, 12, 6))
    velocity, status = dt_s.new_empty(batch, 6), scored.count.new_empty(batch)
    conclude(
        *as_arrays(state.T_cam_obj, prediction.T_cam_obj, prediction.usable, prediction.velocity, prediction.covariance),
        *as_arrays(solution.T_cam_obj, solution.from_prior, solution.hessian),
        *as_arrays(counts, flags, measured, dt_s, objects.centre_obj, objects.diameter_m),
        Limits.from_config(config),
        filled(CorrectionSettings, config.solver, model),
        *as_arrays(remembered, T_last_validated, T_cam_obj, velocity, covariance, left, status),
    )
    health = replace(health, **References(*remembered.unbind())._asdict(), T_last_validated=T_last_validated)
    return MotionState(T_cam_obj, velocity, covariance), health, left, status
