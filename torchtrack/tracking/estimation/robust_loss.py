"""Robust losses of residuals, and the weights that they come to: those far off count less, or not at all."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.constants import scalar_one

# By these numbers, kernels know them.
LOSSES = ("none", "huber", "tukey")


def robust_loss(
    residuals: Float[Tensor, "b n"], scale: Float[Tensor, "b"], loss: str, weight: Float[Tensor, "b n"] | None = None
) -> Float[Tensor, "b n"]:
    """Loss ``ρ(r)`` of each residual, equal to least squares, ``r²/2``, near zero.

    ``loss`` is ``"tukey"`` (constant beyond ``scale``), ``"huber"`` or ``"none"``; ``weight`` is that of :func:`robust_weight`,
    where it is known.
    """
    if loss == "none":
        return 0.5 * residuals.square()
    c = scale[:, None]
    if loss == "huber":
        size = residuals.abs()
        return torch.where(size <= c, 0.5 * residuals.square(), c * (size - 0.5 * c))
    cubed = _inside(residuals, c) ** 3 if weight is None else weight * weight.sqrt()
    return c.square() / 6 * (1 - cubed)


def robust_weight(residuals: Float[Tensor, "b n"], scale: Float[Tensor, "b"], loss: str) -> Float[Tensor, "b n"]:
    """Weight ``ρ'(r) / r`` of each residual (the paper's Eq. 8 for ``"tukey"``): 1 near zero."""
    if loss == "none":
        return torch.ones_like(residuals)
    c = scale[:, None]
    if loss == "huber":
        return (c / residuals.abs().clamp(min=1e-12)).clamp(max=1)
    return _inside(residuals, c).square()


def _inside(residuals: Tensor, c: Tensor) -> Tensor:
    """``1 - (r/c)²``, not below zero."""
    relative = residuals / c
    return torch.addcmul(scalar_one(c), relative, relative, value=-1).clamp(min=0)
