"""The end of a window: what each object's pose is worth, where it goes on from there, and what is remembered."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync, lie
from torchtrack.core.dispatch import accelerable
from torchtrack.core.linalg import inverse
from torchtrack.core.pose_covariance import left_covariance
from torchtrack.tracking.association.polarity import is_seen_well, remembered, remembers_polarity
from torchtrack.tracking.association.weights import ON_CONTOUR_PX
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.estimation.rounds import Fit, may_be_anywhere
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.motion.model import MotionState, fade, with_dropped
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.validation.health import TrackHealth
from torchtrack.tracking.validation.measures import visible_ratio
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.status import (
    Status,
    is_smeared,
    judge,
    partly_hidden,
    trust,
)

# Weight of a new window in the mean score.
USUAL_GAIN = 0.1
# And in references where it is less: what is hidden for a while is not seen well.
FALL_GAIN = 0.005
# A pose that explains this ratio of what it does when seen well, by this ratio of the observations, is remembered as one: most that
# slipped explain less, or are far away, where few explain all.
CERTAIN, CERTAIN_COUNT = 0.9, 0.5


def conclude(
    state: TrackerState,
    prediction: Prediction,
    gate_scale: Float[Tensor, "b"],
    scored: ScoredFit,
    corners: Corners,
    dt_s: Float[Tensor, "b"],
    config: TrackerConfig,
) -> tuple[TrackerState, StepResult]:
    """Judge every object, go on as predicted where it failed, and make the next state.

    Args:
        state: before the window; its times are those of the state and the result that are returned.
        gate_scale: of each object's first gate.
        dt_s: length of the window.
    """
    motion, health, covariance, status = judged_objects(state, prediction, gate_scale, scored, dt_s, config)
    contours = _where_they_are(scored.fit, motion.T_cam_obj, status >= int(Status.LOST), prediction.objects.intrinsics)
    result = StepResult(state.t_us, motion.T_cam_obj, covariance, status, scored.explained_ratio, contours, corners, scored.count)
    appearance = replace(state.appearance, darker_outside=_darker_outside(state, scored, status, dt_s, config))
    return replace(state, motion=motion, health=replace(health, score=scored.score), appearance=appearance), result


def _where_they_are(fit: Fit, T_cam_obj: Float[Tensor, "b 4 4"], failed: Bool[Tensor, "b"], intrinsics: Float[Tensor, "b 4"]) -> Contours:
    """The contours of a fit, of objects that ``failed`` at the poses that they go on from instead."""
    if host_sync.none_of(failed):
        return fit.contours
    fitted = fit.solution.T_cam_obj
    return reproject(fit.contours, torch.where(failed[:, None, None], T_cam_obj.to(fitted.dtype), fitted), intrinsics)


# Motion and health after a window, covariances of the poses' left perturbation, and statuses.
Judgement = tuple[MotionState, TrackHealth, Float[Tensor, "b 6 6"], Int[Tensor, "b"]]


@accelerable
def judged_objects(
    state: TrackerState, prediction: Prediction, gate_scale: Float[Tensor, "b"], scored: ScoredFit, dt_s: Float[Tensor, "b"], config: TrackerConfig
) -> Judgement:
    """What every object's pose is worth, and where it goes on from there: arguments as those of :func:`conclude`."""
    objects, explained, solution, health = prediction.objects, scored.explained_ratio, scored.fit.solution, state.health
    reference = health.reference_explained_ratio
    in_view = visible_ratio(scored.fit.contours, objects.image_size)
    # A new pose of what may be anywhere is no jump, however far away it is; what is not a number stays that.
    step = solution.from_prior[:, :6] * ~(scored.is_relocalized & may_be_anywhere(gate_scale))[:, None]
    hidden = partly_hidden(scored.inlier_ratio, scored.reference_inlier_ratio, scored.count, scored.is_relocalized, config)
    status = judge(explained, scored.count, in_view, step, objects.diameter_m, config.validation, gate_scale, hidden)
    status = torch.where(prediction.usable, status, int(Status.DIVERGED))
    failed = status >= int(Status.LOST)
    T_cam_obj = lie.orthonormalise(torch.where(failed[:, None, None], prediction.T_cam_obj, solution.T_cam_obj).double())
    held = failed if config.motion.without_events == "hold" else failed & ~prediction.usable
    T_cam_obj = torch.where(held[:, None, None], state.T_cam_obj, T_cam_obj)
    trusted = torch.where(failed, 0, torch.maximum(hidden, trust(explained, config.validation, reference, gate_scale)))
    smeared = ~failed & is_smeared(scored.score, reference, scored.inlier_ratio, scored.reference_inlier_ratio)
    status = torch.where(smeared, status.clamp(min=int(Status.UNCERTAIN)), status)
    velocity, covariance = _updated_motion(prediction, scored, failed, trusted, dt_s, config)
    centre_cam = lie.transform_points(T_cam_obj, objects.centre_obj[:, None].double())[:, 0]
    certain = (explained >= CERTAIN * reference) & (status == int(Status.TRACKING))
    certain &= (scored.count >= CERTAIN_COUNT * health.reference_matches) | (not config.uses(Component.MATCH_COUNT))
    health = replace(
        _with_references(health, scored, failed),
        # One good window among bad ones does not end a drift.
        drift_s=(health.drift_s + torch.where(failed, 0, torch.where(smeared, dt_s, -dt_s))).clamp(min=0),
        T_last_validated=torch.where(certain[:, None, None], T_cam_obj.detach(), health.T_last_validated),
        time_since_validated_s=torch.where(certain, 0, health.time_since_validated_s + dt_s),
    )
    return MotionState(T_cam_obj, velocity, covariance), health, left_covariance(covariance[:, :6, :6], centre_cam), status


def _darker_outside(
    state: TrackerState, scored: ScoredFit, status: Int[Tensor, "b"], dt_s: Float[Tensor, "b"], config: TrackerConfig
) -> Float[Tensor, "b 8"]:
    """Which side of contours is the darker one, with what the events on those of objects that are seen well say of it."""
    if not remembers_polarity(config):
        return state.appearance.darker_outside
    matches = scored.fit.matches
    # What was relocalized stands on other matches than these.
    known = (status == int(Status.TRACKING)) & is_seen_well(scored.explained_ratio, state.health.reference_explained_ratio) & ~scored.is_relocalized
    # Chosen, not multiplied: what is not a number would stay.
    weights = torch.where(known[:, None] & (matches.offsets.abs() < ON_CONTOUR_PX), matches.weights, 0)
    return remembered(state.appearance.darker_outside, matches.directions, matches.dark, weights, dt_s)


def _with_references(health: TrackHealth, scored: ScoredFit, failed: Bool[Tensor, "b"]) -> TrackHealth:
    """Mean score and references with a window more; of objects that failed, as before."""
    ratio, inliers, matches = health.reference_explained_ratio, health.reference_inlier_ratio, health.reference_matches
    return replace(
        health,
        mean_score=torch.where(failed, health.mean_score, torch.lerp(health.mean_score, scored.score, USUAL_GAIN)),
        reference_explained_ratio=torch.where(failed, ratio, _seen_well(ratio, scored.explained_ratio)),
        reference_inlier_ratio=torch.where(failed | scored.inlier_ratio.isnan(), inliers, _seen_well(inliers, scored.inlier_ratio)),
        reference_matches=torch.where(failed, matches, _seen_well(matches, scored.count.to(matches.dtype))),
    )


def _seen_well(before: Float[Tensor, "b"], now: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """A running mean of when objects are seen well: it rises fast, and falls slowly."""
    return torch.maximum(*(torch.lerp(before, now, gain) for gain in (USUAL_GAIN, FALL_GAIN)))


def _updated_motion(
    prediction: Prediction, scored: ScoredFit, failed: Bool[Tensor, "b"], trusted: Float[Tensor, "b"], dt_s: Float[Tensor, "b"], config: TrackerConfig
) -> tuple[Float[Tensor, "b 6"], Float[Tensor, "b 12 12"]]:
    """Velocity and covariance after a window: as estimated, as far as that is to be trusted."""
    predicted, solution = prediction.covariance, scored.fit.solution
    if not config.solver.prior:
        return torch.zeros_like(prediction.velocity), predicted
    posterior = config.solver.observation_px**2 * inverse(solution.hessian.double())
    # A sum is finite only where every entry is.
    trusted = trusted * (posterior.sum((1, 2)).abs() < torch.inf)
    velocity = prediction.velocity + trusted[:, None] * solution.from_prior[:, 6:]
    covariance = torch.where(trusted[:, None, None] > 0, torch.lerp(predicted, posterior, trusted[:, None, None].double()), predicted)
    faded = fade(velocity, dt_s, failed, config.motion)
    if config.motion.without_events == "hold":
        covariance = with_dropped(covariance, velocity - faded)
    return faded, covariance
