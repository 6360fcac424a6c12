"""The end of a window: what each object's pose is worth, where it goes on from there, and what is remembered."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import SolverConfig, TrackerConfig
from torchtrack.core import host_sync, lie
from torchtrack.core.dispatch import accelerable
from torchtrack.core.linalg import inverse
from torchtrack.core.pose_covariance import left_covariance
from torchtrack.tracking.association import polarity
from torchtrack.tracking.association.polarity import is_seen_well, remembers_polarity
from torchtrack.tracking.association.weights import ON_CONTOUR_PX
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.estimation.rounds import Fit
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.motion.model import MotionState, fade, with_dropped
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.lost_objects import Relocalized
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.validation.health import TrackHealth
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import Limits, Measured, Verdict, remembered, seen_well, verdict


def conclude(
    state: TrackerState, located: Relocalized, corners: Corners, dt_s: Float[Tensor, "b"], config: TrackerConfig
) -> tuple[TrackerState, StepResult]:
    """Judge every object, go on as predicted where it failed, and make the next state.

    Args:
        state: before the window; its times are those of the state and the result that are returned.
        located: what the window gave.
        dt_s: length of the window.
    """
    scored = located.scored
    motion, health, covariance, status = judged_objects(state, located, dt_s, config)
    contours = _where_they_are(scored.fit, motion.T_cam_obj, status >= int(Status.LOST), located.prediction.objects.intrinsics)
    result = StepResult(state.t_us, motion.T_cam_obj, covariance, status, scored.explained_ratio, contours, corners, scored.count)
    appearance = replace(state.appearance, darker_outside=_darker_outside(state, scored, status, dt_s, config))
    health = replace(health, score=scored.score, reference_normal_spread=_normal_spread(health, scored))
    return replace(state, motion=motion, health=health, appearance=appearance), result


def _where_they_are(fit: Fit, T_cam_obj: Float[Tensor, "b 4 4"], failed: Bool[Tensor, "b"], intrinsics: Float[Tensor, "b 4"]) -> Contours:
    """The contours of a fit, of objects that ``failed`` at the poses that they go on from instead."""
    if host_sync.none_of(failed):
        return fit.contours
    fitted = fit.solution.T_cam_obj
    return reproject(fit.contours, torch.where(failed[:, None, None], T_cam_obj.to(fitted.dtype), fitted), intrinsics)


# Motion and health after a window, covariances of the poses' left perturbation, and statuses.
Judgement = tuple[MotionState, TrackHealth, Float[Tensor, "b 6 6"], Int[Tensor, "b"]]


@accelerable
def judged_objects(state: TrackerState, located: Relocalized, dt_s: Float[Tensor, "b"], config: TrackerConfig) -> Judgement:
    """What every object's pose is worth, and where it goes on from there: arguments as those of :func:`conclude`."""
    prediction, scored = located.prediction, located.scored
    measured, known, limits = measured_of(located), state.health.references, Limits.from_config(config)
    judged = verdict(measured, known, limits)
    T_cam_obj = _corrected_pose(state.T_cam_obj, prediction, scored, judged)
    velocity, covariance = _updated_motion(prediction, scored, judged, dt_s, config.solver)
    centre_cam = lie.transform_points(T_cam_obj, prediction.objects.centre_obj[:, None].double())[:, 0]
    T_last_validated = torch.where(judged.is_certain[:, None, None], T_cam_obj.detach(), state.health.T_last_validated)
    health = replace(state.health, **remembered(known, measured, judged, dt_s, limits)._asdict(), T_last_validated=T_last_validated)
    return MotionState(T_cam_obj, velocity, covariance), health, left_covariance(covariance[:, :6, :6], centre_cam), judged.status


def measured_of(located: Relocalized) -> Measured:
    """What is judged of what a window gave."""
    scored, prediction = located.scored, located.prediction
    rotated_rad, moved_m = scored.fit.solution.from_prior[:, :6].unflatten(1, (2, 3)).norm(dim=-1).unbind(1)
    return Measured(
        explained_ratio=scored.explained_ratio,
        score=scored.score,
        inlier_ratio=scored.inlier_ratio,
        reference_inlier_ratio=scored.reference_inlier_ratio,
        texture_agreement=scored.texture_agreement,
        in_view=scored.visible_ratio,
        gate_scale=located.gate_scale,
        rotated_rad=rotated_rad,
        moved_diameters=moved_m / prediction.objects.diameter_m,
        matched=scored.count,
        near=scored.fit.matches.near.sum(-1),
        is_moving=~scored.measured_ratio.isnan(),
        is_usable=prediction.usable,
        is_relocalized=scored.is_relocalized,
    )


def _corrected_pose(T_before: Float[Tensor, "b 4 4"], prediction: Prediction, scored: ScoredFit, judged: Verdict) -> Float[Tensor, "b 4 4"]:
    """Poses as estimated; those of objects that failed as predicted, or, of those that are ``held``, as they were before."""
    T_cam_obj = lie.orthonormalise(torch.where(judged.failed[:, None, None], prediction.T_cam_obj, scored.fit.solution.T_cam_obj).double())
    held = judged.held | (judged.failed & ~prediction.usable)
    return torch.where(held[:, None, None], T_before, T_cam_obj)


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
    return polarity.remembered(state.appearance.darker_outside, matches.directions, matches.dark, weights, dt_s)


def _normal_spread(health: TrackHealth, scored: ScoredFit) -> Float[Tensor, "b"]:
    """How far apart the directions of contours are when objects are seen well, with a window more."""
    spread = health.reference_normal_spread
    return torch.where(health.time_since_validated_s == 0, seen_well(spread, scored.normal_spread), spread)


def _updated_motion(
    prediction: Prediction, scored: ScoredFit, judged: Verdict, dt_s: Float[Tensor, "b"], config: SolverConfig
) -> tuple[Float[Tensor, "b 6"], Float[Tensor, "b 12 12"]]:
    """Velocity and covariance after a window: as estimated, as far as that is to be trusted; of objects that are ``held``, at rest."""
    predicted, solution = prediction.covariance, scored.fit.solution
    if not config.prior:
        return torch.zeros_like(prediction.velocity), predicted
    posterior = config.observation_px**2 * inverse(solution.hessian.double())
    # A sum is finite only where every entry is.
    trusted = judged.trusted * (posterior.sum((1, 2)).abs() < torch.inf)
    velocity = prediction.velocity + trusted[:, None] * solution.from_prior[:, 6:]
    covariance = torch.where(trusted[:, None, None] > 0, torch.lerp(predicted, posterior, trusted[:, None, None].double()), predicted)
    held = judged.held[:, None]
    return torch.where(held, 0, fade(velocity, dt_s, judged.failed)), with_dropped(covariance, torch.where(held, velocity.detach(), 0))
