"""Random inputs for tests, from CPU generators with fixed seeds."""

import torch
from torch import Tensor

from torchtrack.events import EventBatch
from torchtrack.lie import se3_exp, so3_exp


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator(device="cpu").manual_seed(seed)


def random_twist(*batch: int, seed: int = 0, rotation_rad: float = 1.0, translation_m: float = 0.1, dtype=torch.float64) -> Tensor:
    """Twists ``[*batch, 6]`` whose parts are normally distributed with the given deviations."""
    scale = torch.tensor([rotation_rad] * 3 + [translation_m] * 3, dtype=dtype)
    return torch.randn((*batch, 6), generator=generator(seed), dtype=dtype) * scale


def random_pose(*batch: int, seed: int = 0, depth_m: tuple[float, float] = (0.4, 0.8), spread_m: float = 0.05, dtype=torch.float64) -> Tensor:
    """Poses ``[*batch, 4, 4]`` of objects in front of the camera, with rotations spread over all of SO(3)."""
    rng = generator(seed)
    T = torch.eye(4, dtype=dtype).repeat(*batch, 1, 1)
    T[..., :3, :3] = so3_exp(torch.randn((*batch, 3), generator=rng, dtype=dtype) * 2)
    T[..., :2, 3] = torch.randn((*batch, 2), generator=rng, dtype=dtype) * spread_m
    T[..., 2, 3] = depth_m[0] + torch.rand(batch, generator=rng, dtype=dtype) * (depth_m[1] - depth_m[0])
    return T


def perturbed(T: Tensor, seed: int = 0, rotation_rad: float = 0.01, translation_m: float = 0.001) -> Tensor:
    """Poses moved by small random twists on the left."""
    return se3_exp(random_twist(*T.shape[:-2], seed=seed, rotation_rad=rotation_rad, translation_m=translation_m, dtype=T.dtype)) @ T


def random_events(count: int, *, width: int = 64, height: int = 48, duration_us: int = 10_000, seed: int = 0, stream: int = 0) -> EventBatch:
    """Events spread evenly over sensor and time, sorted by time."""
    rng = generator(seed)
    x = torch.randint(width, (count,), generator=rng).numpy()
    y = torch.randint(height, (count,), generator=rng).numpy()
    t_us = torch.randint(1, duration_us + 1, (count,), generator=rng).sort().values.numpy()
    polarity = torch.randint(2, (count,), generator=rng).numpy()
    return EventBatch.from_numpy(x, y, t_us, polarity, stream)
