"""Smooth object motions: sums of sinusoids around a mean pose, known exactly at any time.

::

    motion = SinusoidMotion.from_config(MotionConfig(position_m=(0, 0, 0.7)), speed=1.0, seed=0)
    T_cam_obj = motion.pose(torch.linspace(0, 1, 5, dtype=torch.float64))     # [5, 4, 4]
    truth = ground_truth(motion, duration_us=1_000_000)                       # Trajectory at 1 kHz

All of it is float64: times are seconds since the start of the scene.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from torchtrack import lie
from torchtrack.config.settings import Settings
from torchtrack.io.trajectory import Trajectory

Vector = tuple[float, float, float]

# Each axis swings with these shares of its amplitude; they sum to one, so the amplitude is never passed.
_WEIGHTS = (0.6, 0.4)
# Frequencies are drawn from these multiples of the base frequency: incommensurate, so that the motion does not repeat soon.
_FREQUENCY_RANGES = ((0.7, 1.0), (1.2, 1.7))
GROUND_TRUTH_RATE_HZ = 1000


class MotionConfig(Settings):
    """How one object moves about its mean pose."""

    position_m: Vector = Field((0.0, 0.0, 0.7), description="Mean position of the object's origin in the camera frame, m.")
    rotation_deg: Vector = Field((0.0, 0.0, 0.0), description="Mean orientation as a rotation vector, degrees.")
    translation_amplitude_m: Vector = Field((0.04, 0.03, 0.03), description="Largest excursion along each camera axis, m.")
    rotation_amplitude_deg: Vector = Field((20.0, 20.0, 20.0), description="Largest excursion about each camera axis, degrees.")
    frequency_hz: float = Field(1.0, ge=0, le=20, description="Base frequency of the swing, Hz.")


@dataclass(frozen=True)
class SinusoidMotion:
    """A motion ``T_cam_obj(t)``: every axis swings with a few sinusoids.

    Args:
        T_mean: mean pose.
        amplitude: largest excursion ``[rotation vector (rad), translation (m)]``.
        frequency_hz, phase: of each axis and sinusoid, Hz and rad.
    """

    T_mean: Float[Tensor, "4 4"]
    amplitude: Float[Tensor, "6"]
    frequency_hz: Float[Tensor, "6 k"]
    phase: Float[Tensor, "6 k"]

    @classmethod
    def from_config(cls, config: MotionConfig, speed: float = 1.0, seed: int = 0) -> "SinusoidMotion":
        """A motion with random frequencies and phases; ``speed`` multiplies every frequency and so every velocity."""
        generator = torch.Generator().manual_seed(seed)
        shape = (6, len(_WEIGHTS))
        low, high = torch.tensor(_FREQUENCY_RANGES, dtype=torch.float64).unbind(-1)
        multiple = low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)
        phase = 2 * math.pi * torch.rand(shape, generator=generator, dtype=torch.float64)
        amplitude = [*map(math.radians, config.rotation_amplitude_deg), *config.translation_amplitude_m]
        return cls(_mean_pose(config), torch.tensor(amplitude, dtype=torch.float64), speed * config.frequency_hz * multiple, phase)

    def pose(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses ``T_cam_obj`` at times in seconds."""
        angle = 2 * math.pi * self.frequency_hz * t_s.double()[:, None, None] + self.phase
        weights = torch.tensor(_WEIGHTS, dtype=torch.float64)
        offset = self.amplitude * (weights * angle.sin()).sum(-1)
        T = self.T_mean.repeat(len(t_s), 1, 1)
        T[:, :3, :3] = lie.so3_exp(offset[:, :3]) @ self.T_mean[:3, :3]
        T[:, :3, 3] += offset[:, 3:]
        return T


def _mean_pose(config: MotionConfig) -> Float[Tensor, "4 4"]:
    """The pose about which the object swings."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = lie.so3_exp(torch.tensor(config.rotation_deg, dtype=torch.float64).deg2rad())
    T[:3, 3] = torch.tensor(config.position_m, dtype=torch.float64)
    return T


def ground_truth(motion: SinusoidMotion, duration_us: int, rate_hz: int = GROUND_TRUTH_RATE_HZ) -> Trajectory:
    """The motion sampled from 0 to ``duration_us``, both included, at ``rate_hz``."""
    t_us = torch.arange(0, duration_us, max(1, round(1e6 / rate_hz)), dtype=torch.int64)
    t_us = torch.cat([t_us, torch.tensor([duration_us])])
    return Trajectory(t_us, motion.pose(t_us.double() * 1e-6))
