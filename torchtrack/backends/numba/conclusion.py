"""What each object's pose is worth, and where it goes on from there: :mod:`torchtrack.tracking.update`, object by object."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.filtering import inverse
from torchtrack.backends.numba.geometry import centre_of, is_finite
from torchtrack.backends.numba.parameters import ConclusionSettings, filled
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking import update
from torchtrack.tracking.estimation.rounds import ANYWHERE
from torchtrack.tracking.motion import model
from torchtrack.tracking.motion.model import MotionState
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation import status
from torchtrack.tracking.validation.measures import visible_ratio
from torchtrack.tracking.validation.scored_fit import ScoredFit

# As torchtrack.tracking.validation.status.Status.
TRACKING, UNCERTAIN, LOST, TOO_FEW_EVENTS, OUT_OF_VIEW, DIVERGED = range(6)
# What is remembered of each object as a number, before a window and after it.
MEAN_SCORE, REFERENCE_EXPLAINED, REFERENCE_INLIERS, REFERENCE_MATCHES, DRIFT_S, UNVALIDATED_S = range(6)
REMEMBERED = 6
# What was measured of it.
EXPLAINED_RATIO, SCORE, INLIER_RATIO, REFERENCE, IN_VIEW, GATE_SCALE = range(6)
MEASURED = 6
_UNKNOWNS = 12
# As torchtrack.tracking.validation.status.trust has it.
_LEAST_RANGE = 1e-6


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
    is_relocalized: Array,
    matched: Array,
    measured: Array,
    dt_s: Array,
    centre_obj: Array,
    diameter_m: Array,
    settings: ConclusionSettings,
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
        is_relocalized, matched: ``[b]``, of the fits: whether they are of a search, and how many observations they have.
        measured: ``[MEASURED, b]``, what else is known of them.
        remembered, T_last_validated: ``[REMEMBERED, b]`` and ``[b, 4, 4]`` before the window; changed to those after it.
        T_cam_obj, new_velocity, posterior, left, status: after the window, ``left`` being the covariance of poses; filled.
    """
    inverses, centre = np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(3)
    for b in range(len(usable)):
        reference, explained, dt = remembered[REFERENCE_EXPLAINED, b], measured[EXPLAINED_RATIO, b], dt_s[b]
        hidden = _hidden(b, is_relocalized, matched, measured, settings)
        status[b] = _judge(b, usable, offset, is_relocalized, matched, measured, hidden, diameter_m[b], settings)
        failed = status[b] >= LOST
        _orthonormalise(T_prior[b] if failed else T_estimated[b], T_cam_obj[b])
        if failed and (settings.holds or not usable[b]):
            T_cam_obj[b] = T_before[b]
        trusted = 0.0 if failed else max(hidden, _trust(explained, reference, measured[GATE_SCALE, b], settings))
        smeared = not failed and _is_smeared(b, measured, reference, settings)
        if smeared:
            status[b] = max(status[b], UNCERTAIN)
        inverse(hessian[b], inverses)
        _update(trusted, failed, dt, velocity[b], covariance[b], offset[b], inverses, settings, new_velocity[b], posterior[b])
        centre_of(T_cam_obj[b], centre_obj[b], centre)
        _to_left(posterior[b], centre, left[b])
        certain = explained >= settings.certain_ratio * reference and status[b] == TRACKING
        certain = certain and matched[b] >= settings.certain_count * remembered[REFERENCE_MATCHES, b]
        _remember(b, failed, smeared, certain, dt, measured, matched[b], settings, remembered)
        if certain:
            T_last_validated[b] = T_cam_obj[b]


@kernel()
def _clamped(value: float, least: float, most: float) -> float:
    """A value between bounds; what is not a number stays that."""
    return least if value < least else (most if value > most else value)


@kernel()
def _judge(
    b: int,
    usable: Array,
    offset: Array,
    is_relocalized: Array,
    matched: Array,
    measured: Array,
    hidden: float,
    diameter_m: float,
    settings: ConclusionSettings,
) -> int:
    """The status of an object: :func:`torchtrack.tracking.validation.status.judge`."""
    gate_scale, explained, status = measured[GATE_SCALE, b], measured[EXPLAINED_RATIO, b], TRACKING
    wider, rotated, moved = _clamped(gate_scale - 1.0, 0.0, 1.0) * (1.0 - hidden), 0.0, 0.0
    # A new pose of what may be anywhere is no jump, however far away it is; what is not a number stays that.
    counts = 0.0 if is_relocalized[b] and gate_scale >= settings.anywhere else 1.0
    for k in range(3):
        rotated += (counts * offset[b, k]) ** 2
        moved += (counts * offset[b, 3 + k]) ** 2
    if explained < settings.uncertain_below:
        status = UNCERTAIN
    if explained < settings.lost_below + (max(settings.refound_above, settings.lost_below) - settings.lost_below) * wider:
        status = LOST
    if matched[b] < settings.min_observations:
        status = TOO_FEW_EVENTS
    if measured[IN_VIEW, b] < settings.min_visible_ratio:
        status = OUT_OF_VIEW
    rotation_ok = np.sqrt(rotated) / gate_scale < settings.max_rotation_rad
    if not (rotation_ok and np.sqrt(moved) / gate_scale < settings.max_translation * diameter_m) or not usable[b]:
        status = DIVERGED
    return status


@kernel()
def _hidden(b: int, is_relocalized: Array, matched: Array, measured: Array, settings: ConclusionSettings) -> float:
    """How far a pose counts as that of an object that is partly hidden: :func:`torchtrack.tracking.validation.status.partly_hidden`."""
    reference = measured[REFERENCE, b]
    if not settings.partly_hidden or is_relocalized[b] or not reference > settings.hidden_least or matched[b] < settings.hidden_observations:
        return 0.0
    ramp = (measured[INLIER_RATIO, b] / reference - settings.hidden_from) / (settings.hidden_fully - settings.hidden_from)
    # Written so that what is not a number counts for nothing.
    return min(ramp, 1.0) if ramp > 0.0 else 0.0


@kernel()
def _trust(explained: float, reference: float, gate_scale: float, settings: ConclusionSettings) -> float:
    """How far a pose counts against the prediction: :func:`torchtrack.tracking.validation.status.trust`."""
    full = max(settings.uncertain_below, settings.validated_from * reference * _clamped(gate_scale - 1.0, 0.0, 1.0))
    return _clamped((explained - settings.lost_below) / max(full - settings.lost_below, _LEAST_RANGE), 0.0, 1.0)


@kernel()
def _is_smeared(b: int, measured: Array, reference: float, settings: ConclusionSettings) -> bool:
    """Whether an object explains too little by smeared events: :func:`torchtrack.tracking.validation.status.is_smeared`."""
    gathers_less = measured[INLIER_RATIO, b] < settings.smeared * measured[REFERENCE, b]
    return gathers_less and measured[SCORE, b] < settings.drift_below * reference


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
    dt: float,
    velocity: Array,
    predicted: Array,
    offset: Array,
    inverses: Array,
    settings: ConclusionSettings,
    new_velocity: Array,
    posterior: Array,
) -> None:
    """Velocity and covariance after a window: as estimated, as far as that is to be trusted; and they fade where nothing confirmed them."""
    variance, total = settings.observation_px**2, 0.0
    for j in range(12):
        for k in range(12):
            total += variance * inverses[j, k]
    trusted *= np.isfinite(total)
    for j in range(12):
        for k in range(12):
            estimated = variance * inverses[j, k]
            posterior[j, k] = estimated + (1.0 - trusted) * (predicted[j, k] - estimated) if trusted > 0 else predicted[j, k]
    kept = (0.0 if settings.holds else np.exp(-dt / settings.coast_s)) if failed else 1.0
    dropped = np.empty(6)
    for k in range(6):
        moving = velocity[k] + trusted * offset[6 + k]
        new_velocity[k] = 0.0 if failed and settings.holds else kept * moving
        dropped[k] = moving - new_velocity[k]
    if settings.holds:
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


@kernel()
def _remember(
    b: int,
    failed: bool,
    smeared: bool,
    certain: bool,
    dt: float,
    measured: Array,
    matched: int,
    settings: ConclusionSettings,
    remembered: Array,
) -> None:
    """What is remembered of an object with a window more: running means, and for how long it drifts, or was not seen well."""
    known = remembered[:, b]
    if not failed:
        known[MEAN_SCORE] += settings.usual_gain * (measured[SCORE, b] - known[MEAN_SCORE])
        known[REFERENCE_EXPLAINED] = _seen_well(known[REFERENCE_EXPLAINED], measured[EXPLAINED_RATIO, b], settings)
        if not np.isnan(measured[INLIER_RATIO, b]):
            known[REFERENCE_INLIERS] = _seen_well(known[REFERENCE_INLIERS], measured[INLIER_RATIO, b], settings)
        known[REFERENCE_MATCHES] = _seen_well(known[REFERENCE_MATCHES], float(matched), settings)
        # One good window among bad ones does not end a drift.
        known[DRIFT_S] += dt if smeared else -dt
    known[DRIFT_S] = _clamped(known[DRIFT_S], 0.0, np.inf)
    known[UNVALIDATED_S] = 0.0 if certain else known[UNVALIDATED_S] + dt


@kernel()
def _seen_well(before: float, now: float, settings: ConclusionSettings) -> float:
    """A running mean of when objects are seen well: it rises fast, and falls slowly."""
    return before + (settings.usual_gain if now > before else settings.fall_gain) * (now - before)


@accelerates(update.judged_objects, supports=lambda state, prediction, gate_scale, scored, dt_s, config: config.solver.prior)
def judged_objects_numba(
    state: TrackerState, prediction: Prediction, gate_scale: Float[Tensor, "b"], scored: ScoredFit, dt_s: Float[Tensor, "b"], config: TrackerConfig
) -> update.Judgement:
    """Object by object."""
    objects, solution, batch = prediction.objects, scored.fit.solution, len(dt_s)
    in_view = visible_ratio(scored.fit.contours, objects.image_size)
    packed = torch.stack([scored.explained_ratio, scored.score, scored.inlier_ratio, scored.reference_inlier_ratio, in_view, gate_scale])
    health = state.health
    references = health.reference_explained_ratio, health.reference_inlier_ratio, health.reference_matches
    remembered = torch.stack([health.mean_score, *references, health.drift_s, health.time_since_validated_s])
    T_last_validated = health.T_last_validated.clone(memory_format=torch.contiguous_format)
    T_cam_obj, covariance, left = (T_last_validated.new_empty(batch, size, size) for size in (4, 12, 6))
    velocity, status_of = dt_s.new_empty(batch, 6), scored.count.new_empty(batch)
    conclude(
        *as_arrays(state.T_cam_obj, prediction.T_cam_obj, prediction.usable, prediction.velocity, prediction.covariance),
        *as_arrays(solution.T_cam_obj, solution.from_prior, solution.hessian),
        *as_arrays(scored.is_relocalized, scored.count, packed, dt_s, objects.centre_obj, objects.diameter_m),
        _settings(config),
        *as_arrays(remembered, T_last_validated, T_cam_obj, velocity, covariance, left, status_of),
    )
    mean_score, explained_ratio, inlier_ratio, matches, drift_s, time_since_validated_s = remembered.unbind()
    health = replace(
        health,
        mean_score=mean_score,
        reference_explained_ratio=explained_ratio,
        reference_inlier_ratio=inlier_ratio,
        reference_matches=matches,
        drift_s=drift_s,
        T_last_validated=T_last_validated,
        time_since_validated_s=time_since_validated_s,
    )
    return MotionState(T_cam_obj, velocity, covariance), health, left, status_of


def _settings(config: TrackerConfig) -> ConclusionSettings:
    """What a kernel goes by that concludes."""
    return filled(
        ConclusionSettings,
        config.validation,
        config.solver,
        model,
        status,
        update,
        holds=config.motion.without_events == "hold",
        anywhere=ANYWHERE,
        smeared=status.SMEARED,
        hidden_observations=status.HIDDEN_TIMES * config.validation.min_observations,
        certain_ratio=update.CERTAIN,
        certain_count=update.CERTAIN_COUNT if config.uses(Component.MATCH_COUNT) else 0.0,
        partly_hidden=config.uses(Component.PARTLY_HIDDEN),
    )
