"""Shared by several tests: windowed."""

from dataclasses import replace

import torch
from helpers import SMALL_CAMERA, generator

from torchtrack.core.camera import project
from torchtrack.core.lie import retract_about, transform_points
from torchtrack.tracking.estimation.terms import PoseProblem, WindowTerms

WINDOW_S = 0.01


# How far the true velocity is from the predicted one (rad/s, m/s).
FASTER = torch.tensor([0.6, -0.4, 0.8, 0.1, -0.08, 0.06], dtype=torch.float64)


def windowed(T_true, *, count=300, faster=FASTER, noise_px=0.0, prior=1e-6, age_s=None, seed=0, dtype=torch.float64):
    """A body that moves by ``faster`` more than predicted, seen at random times of a window."""
    rng = generator(seed)
    batch = len(T_true)
    points = 0.05 * torch.randn((batch, count, 3), generator=rng, dtype=torch.float64)
    angle = 6.28 * torch.rand((batch, count), generator=rng, dtype=torch.float64)
    ages = WINDOW_S * torch.rand((batch, count), generator=rng, dtype=torch.float64) if age_s is None else torch.full((batch, count), age_s).double()
    directions = torch.stack([angle.cos(), angle.sin()], -1)
    intrinsics = SMALL_CAMERA.intrinsics(torch.float64).expand(batch, 4)
    centre = torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64).expand(batch, 3)
    # Where each point was at its own time, by the part of the motion that the prediction left out.
    T_then = retract_about(T_true[:, None].expand(batch, count, 4, 4), -ages[..., None] * faster, centre[:, None].expand(batch, count, 3))
    then = transform_points(T_then.flatten(0, 1), points.flatten(0, 1)[:, None])
    targets = project(then, intrinsics.repeat_interleave(count, 0))[:, 0].unflatten(0, (batch, count))
    targets = targets + noise_px * torch.randn(targets.shape, generator=rng, dtype=torch.float64)
    problem = PoseProblem(
        points_obj=points.to(dtype),
        targets=targets.to(dtype),
        directions=directions.to(dtype),
        weights=torch.ones(batch, count, dtype=dtype),
        intrinsics=intrinsics.to(dtype),
        centre_obj=centre.to(dtype),
        scale_px=torch.full((batch,), 10.0, dtype=dtype),
        T_prior=T_true.to(dtype),
        prior_information=prior * torch.eye(12, dtype=dtype).expand(batch, 12, 12),
    )
    return replace(problem, window=WindowTerms(ages.to(dtype), torch.zeros(batch, 6, dtype=dtype)))
