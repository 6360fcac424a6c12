"""How objects are expected to move from one window to the next: a constant velocity, disturbed by accelerations.

The pose and the velocity of each object have a joint covariance, in the chart of :func:`torchtrack.lie.retract_about`:
``[rotation, move of the centre, angular velocity, velocity of the centre]``. What a window's events say is weighed
against it direction by direction: what they hold well follows them, what they hardly see goes on as it moved before.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import MotionConfig


def initial_covariance(diameter_m: Float[Tensor, "b"], config: MotionConfig) -> Float[Tensor, "b 12 12"]:
    """Covariance of a pose that is given by hand, and of a velocity that is not known."""
    size = torch.ones_like(diameter_m[:, None]).double()
    radius_m = 0.5 * diameter_m[:, None].double()
    shift, speed = config.initial_shift * diameter_m[:, None].double(), config.initial_speed_m_s * size
    sigma = torch.cat([(shift / radius_m).expand(-1, 3), shift.expand(-1, 3), (speed / radius_m).expand(-1, 3), speed.expand(-1, 3)], -1)
    return torch.diag_embed(sigma.square())


def predict_covariance(
    covariance: Float[Tensor, "b 12 12"], velocity: Float[Tensor, "b 6"], dt_s: Float[Tensor, "b"], diameter_m: Float[Tensor, "b"], config: MotionConfig
) -> Float[Tensor, "b 12 12"]:
    """Covariance after ``dt_s`` of constant velocity, with an acceleration that grows with the speed."""
    dt = dt_s.double()[:, None, None]
    eye = torch.eye(6, dtype=torch.float64, device=dt.device).expand(len(dt_s), 6, 6)
    zero = torch.zeros_like(eye)
    carry = torch.cat([torch.cat([eye, dt * eye], -1), torch.cat([zero, eye], -1)], -2)
    radius_m = 0.5 * diameter_m.double()
    speed = velocity[:, 3:].double().norm(dim=-1) + velocity[:, :3].double().norm(dim=-1) * radius_m
    acceleration = config.acceleration_rate_hz * speed + config.acceleration_floor_m_s2
    per_axis = torch.stack([*[acceleration / radius_m] * 3, *[acceleration] * 3], -1)
    push = torch.cat([0.5 * dt.square() * eye, dt * eye], -2) * per_axis[:, None]
    drift = dt.squeeze(-1) * torch.stack([*[config.drift_m_s / radius_m] * 3, *[torch.full_like(radius_m, config.drift_m_s)] * 3], -1)
    noise = push @ push.transpose(-1, -2)
    noise[:, :6, :6] += torch.diag_embed(drift.square())
    return carry @ covariance @ carry.transpose(-1, -2) + noise
