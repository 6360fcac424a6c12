"""Shared by several tests: cost_of, problem_at, cast, far_off, perturbed, LOSSES."""

import torch
from helpers import SMALL_CAMERA, generator, perturbed, random_pose

from torchtrack.core.camera import project
from torchtrack.core.lie import small_difference_about, transform_points
from torchtrack.tracking.estimation.terms import PoseProblem

LOSSES = ["tukey", "huber", "none"]


def problem_at(T_true, count=60, *, outliers=0, noise_px=0.0, prior=0.0, seed=0, dtype=torch.float64, scale_px=5.0):
    """Points of a body of 0.1 m seen at ``T_true [b, 4, 4]``, with one measured direction each; the last are outliers."""
    rng = generator(seed)
    batch = len(T_true)
    points = 0.05 * torch.randn((batch, count, 3), generator=rng, dtype=torch.float64)
    angle = 6.28 * torch.rand((batch, count), generator=rng, dtype=torch.float64)
    intrinsics = SMALL_CAMERA.intrinsics(torch.float64).expand(batch, 4)
    targets = project(transform_points(T_true.double(), points), intrinsics)
    targets = targets + noise_px * torch.randn(targets.shape, generator=rng, dtype=torch.float64)
    targets[:, count - outliers :] += 60 * (torch.rand((batch, outliers, 2), generator=rng, dtype=torch.float64) - 0.5)
    problem = PoseProblem(
        points_obj=points,
        targets=targets,
        directions=torch.stack([angle.cos(), angle.sin()], -1),
        weights=torch.ones(batch, count, dtype=torch.float64),
        intrinsics=intrinsics,
        centre_obj=torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64).expand(batch, 3),
        scale_px=torch.full((batch,), scale_px, dtype=torch.float64),
        T_prior=T_true.double(),
        prior_information=prior * torch.eye(6, dtype=torch.float64).expand(batch, 6, 6),
    )
    return cast(problem, dtype)


def tensors_of(problem):
    """The tensors of a problem, by name; those of further unknowns and terms apart."""
    return {name: value for name, value in vars(problem).items() if isinstance(value, torch.Tensor)}


def cast(problem, dtype):
    return PoseProblem(**{name: value.to(dtype) for name, value in tensors_of(problem).items()})


def cost_of(problem, T, loss):
    """The robust cost of Eq. 12, written out with the camera's own projection."""
    pixels = project(transform_points(T, problem.points_obj), problem.intrinsics)
    residual = ((pixels - problem.targets) * problem.directions).sum(-1)
    c = problem.scale_px[:, None]
    value = {
        "none": 0.5 * residual**2,
        "huber": torch.where(residual.abs() <= c, 0.5 * residual**2, c * (residual.abs() - 0.5 * c)),
        "tukey": torch.where(residual.abs() <= c, c**2 / 6 * (1 - (1 - (residual / c) ** 2) ** 3), c**2 / 6),
    }[loss]
    offset = small_difference_about(problem.T_prior, T, problem.centre_obj)
    prior = 0.5 * (offset[:, None] @ problem.prior_information @ offset[..., None])[:, 0, 0]
    return (value * problem.weights).sum(-1) + prior


def far_off(outliers=10):
    """A hundred starts so far off that undamped steps overshoot."""
    T_true = random_pose(100, seed=7)
    return problem_at(T_true, 30, outliers=outliers), perturbed(T_true, seed=3, rotation_rad=1.5, translation_m=0.08)
