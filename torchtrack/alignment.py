"""One window's alignment: rounds of matching and solving with ever tighter gates."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.contour_index import ContourIndex, index_contours
from torchtrack.contours import Contours, reproject, take_points
from torchtrack.image_motion import object_plane_velocity, pixel_velocity
from torchtrack.lie import transform_points
from torchtrack.matching import Belief, Matches, both_coordinates, match_along_flow, match_nearest
from torchtrack.observations import Observations
from torchtrack.pose_solver import Linearisation, PoseProblem, pose_jacobian, solve_pose

# The index reaches this much beyond the first gate, so that an observation that a round moved is still found (px).
_INDEX_MARGIN_PX = 2


@dataclass(frozen=True)
class Alignment:
    """Where the rounds begin, and what holds them there.

    Args:
        T_prior: predicted pose; some pose in view where the predicted one is not usable.
        usable: which predictions are finite poses before the camera.
        prior_information: information of the prediction in the solver's chart.
        velocity: rotation and velocity of the centre (rad/s, m/s).
        centre_obj: centre of each object (m).
        intrinsics: ``[fx, fy, cx, cy]`` of each object's camera.
        image_size: (height, width) of the image.
    """

    T_prior: Float[Tensor, "b 4 4"]
    usable: Bool[Tensor, "b"]
    prior_information: Float[Tensor, "b 12 12"]
    prior_covariance: Float[Tensor, "b 6 6"]
    velocity: Float[Tensor, "b 6"]
    centre_obj: Float[Tensor, "b 3"]
    intrinsics: Float[Tensor, "b 4"]
    image_size: tuple[int, int]

    def centre_cam(self, T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 3"]:
        """Centre of each object in the camera's frame (m)."""
        return transform_points(T_cam_obj, self.centre_obj[:, None])[:, 0]

    def plane_velocity(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Image velocity of pixels at the depth of the object's centre (px/s)."""
        return object_plane_velocity(pixels, self.velocity, self.centre_cam(self.T_prior), self.intrinsics)

    def contour_velocity(self, contours: Contours) -> Float[Tensor, "b m 2"]:
        """Image velocity of contour points (px/s)."""
        return pixel_velocity(contours.points_cam, self.velocity, self.centre_cam(self.T_prior), self.intrinsics)


@dataclass(frozen=True)
class AlignmentResult:
    """The pose after the last round, and what it stands on."""

    solution: Linearisation
    contours: Contours
    matches: Matches


# Contour points whose uncertainty is looked at.
_LOOKED_AT = 64


def gate_scale(start: Alignment, contours: Contours, config: TrackerConfig) -> Float[Tensor, "b"]:
    """How much wider than configured the first gate must be for what the prediction may be off: at least 1."""
    limit = config.matching.max_gate_px / config.matching.gates_px[0]
    if limit <= 1:
        return torch.ones_like(start.velocity[:, 0])
    step = max(contours.mask.shape[1] // _LOOKED_AT, 1)
    points, normals, mask = contours.points_cam[:, ::step], contours.normals[:, ::step], contours.mask[:, ::step]
    inverse_depth = points[..., 2].clamp(min=1e-3).reciprocal()
    slope = normals * start.intrinsics[:, None, :2] * inverse_depth[..., None]
    along = (slope * points[..., :2]).sum(-1) * inverse_depth
    jacobian = pose_jacobian(points.transpose(1, 2), start.centre_cam(start.T_prior), (*slope.unbind(-1), -along))
    variance = (jacobian * (start.prior_covariance @ jacobian)).sum(1)
    sigma_px = ((variance * mask).sum(-1) / mask.sum(-1).clamp(min=1)).sqrt()
    return (config.matching.gate_sigmas * sigma_px / config.matching.gates_px[0]).clamp(1, limit)


def index_for(contours: Contours, image_size: tuple[int, int], config: TrackerConfig, scale: float = 1.0) -> ContourIndex:
    """The index of contours, wide enough for the first gate."""
    radius_px = int(scale * max(config.matching.gates_px)) + _INDEX_MARGIN_PX
    return index_contours(contours, image_size, radius_px, config.matching.index_cell_px)


def align(
    start: Alignment,
    contours: Contours,
    index: ContourIndex,
    scale: Float[Tensor, "b"],
    observations: Observations,
    extract: Callable[[Float[Tensor, "b 4 4"]], Contours],
    config: TrackerConfig,
    T_cam_obj: Tensor | None = None,
    from_prior: Tensor | None = None,
) -> AlignmentResult:
    """Match and solve, one round per gate.

    Args:
        contours: visible contours at ``start.T_prior``, and ``index`` of them.
        extract: makes contours at a pose anew, in the rounds that ``config.contours.refresh_rounds`` names.
    """
    if T_cam_obj is None:
        T_cam_obj, from_prior = start.T_prior, torch.zeros(len(start.velocity), 13).to(start.velocity)
    start_now = replace(start, velocity=start.velocity + from_prior[:, 6:12])
    compensate = 1.0 if config.matching.motion_compensation else 0.0
    plane = compensate * start_now.plane_velocity(observations.pixels)
    belief = Belief.from_velocity(plane)
    velocity = compensate * start_now.contour_velocity(contours)
    rounds = len(config.matching.gates_px)
    for number, base_px in enumerate(config.matching.gates_px):
        widen = scale ** (1 - number / max(rounds - 1, 1))
        gate_px = base_px * widen
        if number and number in config.contours.refresh_rounds:
            contours = extract(T_cam_obj)
            index = index_for(contours, start.image_size, config)
            velocity = compensate * start.contour_velocity(contours)
            belief = Belief.from_velocity(belief.motion[..., :2])
        matches, belief = _match(observations, contours, index, belief, velocity, gate_px, widen, config)
        rows = both_coordinates(matches) if config.matching.residual == "point" else matches
        solution = solve_pose(_problem(start, rows, contours, gate_px, config, from_prior[:, 6:12], observations.age_s), T_cam_obj, config.solver, from_prior)
        T_cam_obj, from_prior = solution.T_cam_obj, solution.from_prior
        contours = reproject(contours, T_cam_obj, start.intrinsics)
        velocity = compensate * pixel_velocity(contours.points_cam, start.velocity + from_prior[:, 6:12], start.centre_cam(T_cam_obj), start.intrinsics)
    return AlignmentResult(solution, contours, matches)


def _match(
    observations: Observations,
    contours: Contours,
    index: ContourIndex,
    belief: Belief,
    contour_velocity: Float[Tensor, "b m 2"],
    gate_px: Float[Tensor, "b"],
    widen: Float[Tensor, "b"],
    config: TrackerConfig,
) -> tuple[Matches, Belief]:
    """Matches of one round, none for an object with too few of them, and what the next round begins with."""
    if config.matching.along_flow:
        matches = match_along_flow(observations, contours, contour_velocity, gate_px, config.matching)
    else:
        matches, belief = match_nearest(observations, contours, index, belief, contour_velocity, gate_px, widen, config.matching)
    enough = (matches.mask * matches.weights).sum(-1, keepdim=True) >= config.quality.min_observations
    return replace(matches, mask=matches.mask & enough), belief


def _problem(start: Alignment, matches: Matches, contours: Contours, gate_px: Tensor, config: TrackerConfig, compensated: Tensor, ages_s: Tensor) -> PoseProblem:
    """The least squares problem of one round; objects without a match stay where they are."""
    return PoseProblem(
        points_obj=take_points(contours.points_obj, matches.contour),
        targets=matches.targets,
        directions=matches.directions,
        weights=matches.mask * matches.weights,
        intrinsics=start.intrinsics,
        centre_obj=start.centre_obj,
        scale_px=gate_px,
        T_prior=start.T_prior,
        prior_information=start.prior_information,
        ages_s=ages_s,
        compensated=compensated,
        swelling=take_points((contours.kind <= config.solver.swelling_kind).to(ages_s)[..., None], matches.contour)[..., 0],
    )
