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
from torchtrack.pose_solver import Linearisation, PoseProblem, solve_pose

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
    prior_information: Float[Tensor, "b 6 6"]
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


def index_for(contours: Contours, image_size: tuple[int, int], config: TrackerConfig) -> ContourIndex:
    """The index of contours, wide enough for the first gate."""
    radius_px = int(max(config.matching.gates_px)) + _INDEX_MARGIN_PX
    return index_contours(contours, image_size, radius_px, config.matching.index_cell_px)


def align(
    start: Alignment,
    contours: Contours,
    index: ContourIndex,
    observations: Observations,
    extract: Callable[[Float[Tensor, "b 4 4"]], Contours],
    config: TrackerConfig,
) -> AlignmentResult:
    """Match and solve, one round per gate.

    Args:
        contours: visible contours at ``start.T_prior``, and ``index`` of them.
        extract: makes contours at a pose anew, in the rounds that ``config.contours.refresh_rounds`` names.
    """
    T_cam_obj, from_prior = start.T_prior, torch.zeros_like(start.velocity)
    compensate = 1.0 if config.matching.motion_compensation else 0.0
    plane = compensate * start.plane_velocity(observations.pixels)
    belief = Belief.from_velocity(plane)
    velocity = compensate * start.contour_velocity(contours)
    for number, gate_px in enumerate(config.matching.gates_px):
        if number and number in config.contours.refresh_rounds:
            contours = extract(T_cam_obj)
            index = index_for(contours, start.image_size, config)
            velocity = compensate * start.contour_velocity(contours)
            belief = Belief.from_velocity(belief.motion[..., :2])
        matches, belief = _match(observations, contours, index, belief, velocity, gate_px, config)
        rows = both_coordinates(matches) if config.matching.residual == "point" else matches
        solution = solve_pose(_problem(start, rows, contours, gate_px, config), T_cam_obj, config.solver, from_prior)
        T_cam_obj, from_prior = solution.T_cam_obj, solution.from_prior
        contours = reproject(contours, T_cam_obj, start.intrinsics)
    return AlignmentResult(solution, contours, matches)


def _match(
    observations: Observations,
    contours: Contours,
    index: ContourIndex,
    belief: Belief,
    contour_velocity: Float[Tensor, "b m 2"],
    gate_px: float,
    config: TrackerConfig,
) -> tuple[Matches, Belief]:
    """Matches of one round, none for an object with too few of them, and what the next round begins with."""
    if config.matching.along_flow:
        matches = match_along_flow(observations, contours, contour_velocity, gate_px, config.matching)
    else:
        matches, belief = match_nearest(observations, contours, index, belief, contour_velocity, gate_px, config.matching)
    enough = (matches.mask * matches.weights).sum(-1, keepdim=True) >= config.quality.min_observations
    return replace(matches, mask=matches.mask & enough), belief


def _problem(start: Alignment, matches: Matches, contours: Contours, gate_px: float, config: TrackerConfig) -> PoseProblem:
    """The least squares problem of one round; objects without a match stay where they are."""
    idle = ~matches.mask.any(-1)
    information = torch.where(idle[:, None, None], torch.zeros_like(start.prior_information), start.prior_information)
    return PoseProblem(
        points_obj=take_points(contours.points_obj, matches.contour),
        targets=matches.targets,
        directions=matches.directions,
        weights=matches.mask * matches.weights,
        intrinsics=start.intrinsics,
        centre_obj=start.centre_obj,
        scale_px=torch.full_like(start.centre_obj[:, 0], gate_px),
        T_prior=start.T_prior,
        prior_information=information,
    )
