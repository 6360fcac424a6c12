"""One window's alignment: rounds of matching and solving with ever tighter gates."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.contour_index import ContourIndex, index_contours
from torchtrack.contours import ContourKind, Contours, reproject, take_points
from torchtrack.implicit_gradient import with_gradient
from torchtrack.matching import Belief, Matches, both_coordinates, match_along_flow, match_nearest
from torchtrack.motion import inverse
from torchtrack.observations import Observations
from torchtrack.pose_solver import Linearisation, PoseProblem, WindowTerms, solve_pose
from torchtrack.prediction import Prediction

# The index reaches this much beyond the first gate, so that an observation that a round moved is still found (px).
_INDEX_MARGIN_PX = 2
# Standard deviation of a swelling that is switched off (px).
_NO_SWELLING_PX = 1e-3


@dataclass(frozen=True)
class Fit:
    """The poses after the last round, and what they stand on.

    Args:
        solution: the solver's last linearisation.
        contours: at the poses.
        matches: of the last round.
    """

    solution: Linearisation
    contours: Contours
    matches: Matches


def gate_widening(sigma_px: Float[Tensor, "b"], config: TrackerConfig) -> Float[Tensor, "b"]:
    """How many times wider than configured the first gate is, for predictions of that standard deviation: at least 1."""
    matching = config.matching
    first_px = matching.gates_px[0]
    return (matching.gate_sigmas * sigma_px / first_px).clamp(1, max(matching.max_gate_px / first_px, 1))


def index_for(contours: Contours, image_size: tuple[int, int], config: TrackerConfig, widening: Float[Tensor, "b"]) -> ContourIndex:
    """The index of contours, wide enough for each object's first gate."""
    radius_px = (widening * max(config.matching.gates_px)).long() + _INDEX_MARGIN_PX
    return index_contours(contours, image_size, radius_px, config.matching.index_cell_px)


def align(
    prediction: Prediction,
    contours: Contours,
    index: ContourIndex,
    widening: Float[Tensor, "b"],
    observations: Observations,
    config: TrackerConfig,
    offset: Float[Tensor, "b 13"] | None = None,
) -> Fit:
    """Match and solve, one round per gate.

    Gradients are those of the last round's problem at its solution: what came before chose the matches, which do not bend.

    Args:
        prediction: what the prior draws to.
        contours: visible contours where the rounds begin, and ``index`` of them.
        widening: of each object's first gate; it is taken back by the last.
        offset: of the beginning from the prediction: pose, velocity and swelling; none when not given.
    """
    objects = prediction.objects
    if offset is None:
        offset = prediction.velocity.new_zeros(len(widening), 13)
    information = _information(prediction, config)
    begin = prediction.moved(offset) if config.solver.prior else prediction
    T_cam_obj, offset = begin.T_cam_obj, offset[:, : information.shape[-1]]
    compensate = 1.0 if config.matching.motion_compensation else 0.0
    belief = Belief.from_velocity(compensate * begin.plane_velocity(observations.pixels))
    rounds = len(config.matching.gates_px)
    for number, gate_px in enumerate(config.matching.gates_px):
        if number and number in config.contours.refresh_rounds:
            contours = objects.contours(T_cam_obj, config.contours)
            index = index_for(contours, objects.image_size, config, widening)
            belief = Belief.from_velocity(belief.motion[..., :2])
        wider = widening ** (1 - number / max(rounds - 1, 1))
        velocity = compensate * begin.contour_velocity(contours)
        matches, belief = _match(observations, contours, index, belief, velocity, gate_px, wider, config)
        rows = both_coordinates(matches) if config.matching.residual == "point" else matches
        problem = _problem(prediction, information, rows, contours, gate_px * wider)
        if config.solver.prior:
            problem = replace(problem, window=_window_terms(observations, contours, rows, offset, config))
        solution = solve_pose(problem, T_cam_obj, config.solver, offset)
        T_cam_obj, offset = solution.T_cam_obj, solution.from_prior
        contours = reproject(contours, T_cam_obj, objects.intrinsics)
        if config.solver.prior:
            begin = replace(prediction, T_cam_obj=T_cam_obj, velocity=prediction.velocity + offset[:, 6:12])
    solution = with_gradient(problem, solution, config.solver)
    return Fit(solution, contours, matches)


def _information(prediction: Prediction, config: TrackerConfig) -> Tensor:
    """Information of the prediction in the solver's chart, for observations of unit weight: 13 of them, or none for the pose."""
    if not config.solver.prior:
        return prediction.velocity.new_zeros(len(prediction.velocity), 6, 6)
    swelling_px = config.solver.swelling_px or _NO_SWELLING_PX
    information = prediction.covariance.new_zeros(len(prediction.covariance), 13, 13)
    information[:, :12, :12] = inverse(prediction.covariance)
    information[:, 12, 12] = swelling_px**-2
    return (config.solver.observation_px**2 * information).to(prediction.velocity.dtype)


def _match(
    observations: Observations,
    contours: Contours,
    index: ContourIndex,
    belief: Belief,
    contour_velocity: Float[Tensor, "b m 2"],
    gate_px: float,
    wider: Float[Tensor, "b"],
    config: TrackerConfig,
) -> tuple[Matches, Belief]:
    """Matches of one round, none for an object with too few of them, and what the next round begins with."""
    if config.matching.along_flow:
        matches = match_along_flow(observations, contours, contour_velocity, gate_px, config.matching)
    else:
        matches, belief = match_nearest(observations, contours, index, belief, contour_velocity, gate_px, config.matching, wider)
    if observations.trust is not None:
        matches = replace(matches, weights=matches.weights * observations.trust)
    enough = (matches.mask * matches.weights).sum(-1, keepdim=True) >= config.quality.min_observations
    return replace(matches, mask=matches.mask & enough), belief


def _window_terms(
    observations: Observations, contours: Contours, matches: Matches, offset: Float[Tensor, "b 13"], config: TrackerConfig
) -> WindowTerms:
    """What observations tell beside the pose: of the velocity by their ages, and of how far limbs stand out."""
    # Two rows for each observation where both of its coordinates count.
    age_s = observations.age_s.repeat(1, 2 if config.matching.residual == "point" else 1)
    if not config.solver.velocity_in_window:
        age_s = torch.zeros_like(age_s)
    limb = ((contours.kind == int(ContourKind.LIMB)) & (config.matching.residual == "normal")).to(age_s.dtype)
    return WindowTerms(age_s, offset[:, 6:12], take_points(limb[..., None], matches.contour)[..., 0])


def _problem(prediction: Prediction, information: Tensor, matches: Matches, contours: Contours, gate_px: Float[Tensor, "b"]) -> PoseProblem:
    """The least squares problem of one round; objects without a match stay where they are."""
    return PoseProblem(
        points_obj=take_points(contours.points_obj, matches.contour),
        targets=matches.targets,
        directions=matches.directions,
        weights=matches.mask * matches.weights,
        intrinsics=prediction.objects.intrinsics,
        centre_obj=prediction.objects.centre_obj,
        scale_px=gate_px,
        T_prior=prediction.T_cam_obj,
        prior_information=information,
    )
