"""Whether a pose can be trusted: status, covariance, and the share of the moving contour that events explain.

The residual does not tell: a slip onto a parallel edge has a small one.
"""

from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import QualityConfig
from torchtrack.contours import Contours
from torchtrack.lie import hat
from torchtrack.matching import Matches, patch, patch_counts
from torchtrack.pose_solver import Linearisation, solve_positive

# A patch explains its contours when this many observations are on them, and this share of those near them.
_MIN_ON_CONTOUR, _LEAST_SHARE = 3, 0.5
# Fewer moving contour points than this say nothing.
_MIN_MOVING_POINTS = 16


class Status(IntEnum):
    """What a pose is worth."""

    TRACKING = 0
    UNCERTAIN = 1
    LOST = 2
    TOO_FEW_EVENTS = 3
    OUT_OF_VIEW = 4
    DIVERGED = 5


def explained_share(
    contours: Contours, matches: Matches, contour_velocity: Float[Tensor, "b m 2"], image_size: tuple[int, int], min_speed_px_s: float
) -> Float[Tensor, "b"]:
    """Of the visible contour that should fire given its motion, the share with a matched observation beside it.

    One where hardly anything moves: nothing speaks against the pose.
    """
    inside = _inside(contours.pixels, image_size)
    on_count, near_count = patch_counts(matches.offsets, matches.targets, matches.near)
    cell = patch(contours.pixels)
    on, near = on_count.gather(1, cell), near_count.gather(1, cell)
    explained = (on >= _MIN_ON_CONTOUR) & (on + 1 > _LEAST_SHARE * (near + 2))
    speed = (contours.normals * contour_velocity).sum(-1).abs()
    moving = contours.mask & inside & (speed > min_speed_px_s)
    total = moving.sum(-1)
    share = (moving & explained).sum(-1) / total.clamp(min=1)
    return torch.where(total < _MIN_MOVING_POINTS, 1.0, share).to(contours.pixels.dtype)


def _inside(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Which pixels lie in the image."""
    height, width = image_size
    u, v = pixels.unbind(-1)
    return (u >= 0) & (v >= 0) & (u < width) & (v < height)


def visible_share(contours: Contours, image_size: tuple[int, int]) -> Float[Tensor, "b"]:
    """Share of an object's contour points that lie in the image; zero without any."""
    height, width = image_size
    u, v = contours.pixels.unbind(-1)
    inside = contours.mask & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    return inside.sum(-1) / contours.mask.sum(-1).clamp(min=1)


def pose_covariance(solution: Linearisation, observation_count: Int[Tensor, "b"], centre_cam: Float[Tensor, "b 3"]) -> Float[Tensor, "b 6 6"]:
    """Covariance of the left perturbation ``[φ, ρ]`` (rad, m) of the pose; infinite on the diagonal where unknown.

    From the Gauss-Newton Hessian and the variance of the residuals, which is twice the mean robust cost.
    """
    hessian = solution.hessian
    variance_px2 = 2 * solution.cost / observation_count.clamp(min=1)
    eye = torch.eye(6, dtype=hessian.dtype, device=hessian.device).repeat(len(hessian), 1, 1)
    inverse, known = solve_positive(hessian, eye)
    # The solver turns about the object's centre: ρ_left = ρ - φ × c.
    to_left = eye.clone()
    to_left[:, 3:, :3] = hat(centre_cam)
    covariance = to_left @ (inverse * variance_px2[:, None, None]) @ to_left.transpose(1, 2)
    return torch.where(known[:, None, None], covariance, torch.diag_embed(torch.full_like(centre_cam.repeat(1, 2), torch.inf)))


def judge(
    quality: Float[Tensor, "b"],
    observation_count: Int[Tensor, "b"],
    in_view: Float[Tensor, "b"],
    step_from_prediction: Float[Tensor, "b 6"],
    diameters_m: Float[Tensor, "b"],
    config: QualityConfig,
) -> Int[Tensor, "b"]:
    """The :class:`Status` of each object, the gravest reason first."""
    turned = step_from_prediction[:, :3].norm(dim=-1)
    moved = step_from_prediction[:, 3:].norm(dim=-1) / diameters_m
    diverged = ~(turned < config.max_step_rotation_rad) | ~(moved < config.max_step_translation)
    status = torch.full_like(observation_count, int(Status.TRACKING))
    reasons: list[tuple[Status, Bool[Tensor, "b"]]] = [
        (Status.UNCERTAIN, quality < config.uncertain_below),
        (Status.LOST, quality < config.lost_below),
        (Status.TOO_FEW_EVENTS, observation_count < config.min_observations),
        (Status.OUT_OF_VIEW, in_view < config.min_visible_share),
        (Status.DIVERGED, diverged),
    ]
    for reason, holds in reasons:
        status = torch.where(holds, int(reason), status)
    return status
