"""Smooth motions of objects and cameras, known exactly at any time.

::

    motion = make_motion(MotionConfig(position_m=(0, 0, 0.7)), speed=1.0, seed=0)
    T_cam_obj = motion.pose(torch.linspace(0, 1, 5, dtype=torch.float64))     # [5, 4, 4]
    truth = ground_truth(motion, duration_us=1_000_000)                       # Trajectory at 1 kHz

========== ====================================================================================
``swing``  every axis swings with two sinusoids about a mean pose
``random`` the same with six sinusoids of random frequency: smooth, and never the same
``spin``   a swing with a steady turn about an axis through the object's origin
``keys``   a spline through given poses: continuous in acceleration
``file``   a spline through the poses of a TUM file
========== ====================================================================================

All of it is float64: times are seconds since the start of the scene.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.core import lie
from torchtrack.io.trajectory import Trajectory, read_tum

Vector = tuple[float, float, float]

# Each axis swings with these shares of its amplitude; they sum to one, so the amplitude is never passed.
_WEIGHTS = (0.6, 0.4)
# Frequencies are drawn from these multiples of the base frequency: incommensurate, so that the motion does not repeat soon.
_FREQUENCY_RANGES = ((0.7, 1.0), (1.2, 1.7))
_RANDOM_WEIGHTS = (0.24, 0.2, 0.18, 0.15, 0.13, 0.1)
_RANDOM_RANGES = ((0.1, 1.6),) * 6
GROUND_TRUTH_RATE_HZ = 1000
# Half the time over which velocities are taken as differences, s.
_HALF_STEP_S = 1e-5


class KeyPose(Settings):
    """A pose that a motion passes at a given time."""

    t_s: float = Field(description="Time since the start of the scene, s.")
    position_m: Vector = Field(description="Position, m.")
    rotation_deg: Vector = Field((0.0, 0.0, 0.0), description="Orientation as a rotation vector, degrees.")


class MotionConfig(Settings):
    """How one object moves, in the world's frame: that of the camera, where the camera does not move."""

    kind: Literal["swing", "random", "spin", "keys", "file"] = Field("swing", description="What kind of motion.")
    position_m: Vector = Field((0.0, 0.0, 0.7), description="Mean position of the object's origin, m (swing, random, spin).")
    rotation_deg: Vector = Field((0.0, 0.0, 0.0), description="Mean orientation as a rotation vector, degrees (swing, random, spin).")
    translation_amplitude_m: Vector = Field((0.04, 0.03, 0.03), description="Largest excursion along each axis, m (swing, random, spin).")
    rotation_amplitude_deg: Vector = Field((20.0, 20.0, 20.0), description="Largest excursion about each axis, degrees (swing, random, spin).")
    frequency_hz: float = Field(1.0, ge=0, le=20, description="Base frequency of the swing, Hz (swing, random, spin).")
    spin_axis: Vector = Field((0.0, 1.0, 0.0), description="Axis of a spin, world frame; its length does not matter.")
    spin_deg_s: float = Field(90.0, ge=-36_000, le=36_000, description="Speed of a spin, degrees per second.")
    keys: tuple[KeyPose, ...] = Field((), description="Poses to pass, in the order of time; at rest before the first and after the last.")
    file: ConfigPath | None = Field(None, description="TUM file of poses; its first time is the start of the scene.")

    @model_validator(mode="after")
    def _consistent(self) -> "MotionConfig":
        if (self.kind == "keys") != bool(self.keys) or (self.kind == "file") != (self.file is not None):
            raise ValueError(f"the kind 'keys' needs keys, the kind 'file' a file, and no other kind takes them; got the kind '{self.kind}'")
        if self.keys and (len(self.keys) < 2 or any(b.t_s <= a.t_s for a, b in zip(self.keys, self.keys[1:], strict=False))):
            raise ValueError("keys: give two or more, at increasing times")
        if self.kind == "spin" and not any(self.spin_axis):
            raise ValueError("spin_axis: must not be all zero")
        return self


class CameraMotionConfig(MotionConfig):
    """How the camera moves: its pose in the world."""

    position_m: Vector = Field((0.0, 0.0, 0.0), description="Mean position of the camera in the world, m (swing, random, spin).")


@runtime_checkable
class Motion(Protocol):
    """A rigid motion over time."""

    def pose(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses at times in seconds."""
        ...


@dataclass(frozen=True)
class SinusoidMotion:
    """Every axis swings with a few sinusoids.

    Args:
        T_mean: mean pose.
        amplitude: largest excursion ``[rotation vector (rad), translation (m)]``.
        frequency_hz, phase: of each axis and sinusoid, Hz and rad.
        weights: share of each sinusoid; they sum to one.
    """

    T_mean: Float[Tensor, "4 4"]
    amplitude: Float[Tensor, "6"]
    frequency_hz: Float[Tensor, "6 k"]
    phase: Float[Tensor, "6 k"]
    weights: tuple[float, ...] = _WEIGHTS

    @classmethod
    def from_config(cls, config: MotionConfig, speed: float = 1.0, seed: int = 0) -> "SinusoidMotion":
        """A motion with random frequencies and phases; ``speed`` multiplies every frequency and so every velocity."""
        weights, ranges = (_RANDOM_WEIGHTS, _RANDOM_RANGES) if config.kind == "random" else (_WEIGHTS, _FREQUENCY_RANGES)
        generator = torch.Generator().manual_seed(seed)
        shape = (6, len(weights))
        low, high = torch.tensor(ranges, dtype=torch.float64).unbind(-1)
        multiple = low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)
        phase = 2 * math.pi * torch.rand(shape, generator=generator, dtype=torch.float64)
        amplitude = [*map(math.radians, config.rotation_amplitude_deg), *config.translation_amplitude_m]
        return cls(_mean_pose(config), torch.tensor(amplitude, dtype=torch.float64), speed * config.frequency_hz * multiple, phase, weights)

    def pose(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses at times in seconds."""
        angle = 2 * math.pi * self.frequency_hz * t_s.double()[:, None, None] + self.phase
        weights = torch.tensor(self.weights, dtype=torch.float64)
        offset = self.amplitude * (weights * angle.sin()).sum(-1)
        T = self.T_mean.repeat(len(t_s), 1, 1)
        T[:, :3, :3] = lie.so3_exp(offset[:, :3]) @ self.T_mean[:3, :3]
        T[:, :3, 3] += offset[:, 3:]
        return T


@dataclass(frozen=True)
class SpinMotion:
    """A motion with a steady turn about an axis through the origin of what moves.

    Args:
        base: the motion without the turn.
        angular_velocity: rad/s, world frame.
    """

    base: Motion
    angular_velocity: Float[Tensor, "3"]

    def pose(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses at times in seconds."""
        T = self.base.pose(t_s).clone()
        T[:, :3, :3] = lie.so3_exp(t_s.double()[:, None] * self.angular_velocity) @ T[:, :3, :3]
        return T


@dataclass(frozen=True)
class AttachedMotion:
    """A motion relative to something that moves itself.

    Args:
        carrier: the motion of what carries it.
        relative: its motion in the carrier's frame.
    """

    carrier: Motion
    relative: Motion

    def pose(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses at times in seconds."""
        return self.carrier.pose(t_s) @ self.relative.pose(t_s)


class SplineMotion:
    """A cubic spline in position and in rotation (scipy's ``RotationSpline``) through poses; at rest beyond both ends.

    Args:
        t_s: times of the poses since the start, s.
        T: the poses.
        speed: multiplies the time.
    """

    def __init__(self, t_s: Float[Tensor, "k"], T: Float[Tensor, "k 4 4"], speed: float = 1.0) -> None:
        self._ends, self._speed = (float(t_s[0]), float(t_s[-1])), speed
        self._position = CubicSpline(t_s.numpy(), T[:, :3, 3].numpy(), bc_type="natural")
        self._rotation = RotationSpline(t_s.numpy(), Rotation.from_matrix(T[:, :3, :3].numpy()))

    def pose(self, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 4 4"]:
        """Poses at times in seconds."""
        at = (t_s.double() * self._speed).clamp(*self._ends).numpy()
        T = torch.eye(4, dtype=torch.float64).repeat(len(t_s), 1, 1)
        T[:, :3, :3] = torch.from_numpy(self._rotation(at).as_matrix())
        T[:, :3, 3] = torch.from_numpy(self._position(at))
        return T


def make_motion(config: MotionConfig, speed: float = 1.0, seed: int = 0) -> Motion:
    """The motion that a config describes; ``speed`` multiplies every velocity, ``seed`` draws what is random.

    Raises:
        MissingFileError, PoseError: if there is something wrong with its file.
    """
    if config.kind == "keys":
        t_s = torch.tensor([key.t_s for key in config.keys], dtype=torch.float64)
        return SplineMotion(t_s, torch.stack([pose_matrix(key.position_m, key.rotation_deg) for key in config.keys]), speed)
    if config.file is not None:
        trajectory = read_tum(config.file)
        # A spline needs two poses; one alone is a motion that rests.
        if len(trajectory) == 1:
            trajectory = Trajectory(trajectory.t_us[0] + torch.tensor([0, 1]), trajectory.T_cam_obj.expand(2, 4, 4))
        return SplineMotion((trajectory.t_us - trajectory.t_us[0]).double() * 1e-6, lie.orthonormalise(trajectory.T_cam_obj), speed)
    swing = SinusoidMotion.from_config(config, speed, seed)
    if config.kind != "spin":
        return swing
    axis = torch.tensor(config.spin_axis, dtype=torch.float64)
    return SpinMotion(swing, axis / axis.norm() * math.radians(config.spin_deg_s) * speed)


def pose_matrix(position_m: Vector, rotation_deg: Vector) -> Float[Tensor, "4 4"]:
    """The pose of a position and a rotation vector in degrees."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = lie.so3_exp(torch.tensor(rotation_deg, dtype=torch.float64).deg2rad())
    T[:3, 3] = torch.tensor(position_m, dtype=torch.float64)
    return T


def _mean_pose(config: MotionConfig) -> Float[Tensor, "4 4"]:
    """The pose about which the object swings."""
    return pose_matrix(config.position_m, config.rotation_deg)


PoseFunction = Callable[[Float[Tensor, "q"]], Float[Tensor, "q 4 4"]]


def truth_times(duration_us: int, rate_hz: int = GROUND_TRUTH_RATE_HZ) -> Tensor:
    """Times (µs) from 0 to ``duration_us``, both included, at ``rate_hz``."""
    t_us = torch.arange(0, duration_us, max(1, round(1e6 / rate_hz)), dtype=torch.int64)
    return torch.cat([t_us, torch.tensor([duration_us])])


def ground_truth(motion: Motion, duration_us: int, rate_hz: int = GROUND_TRUTH_RATE_HZ) -> Trajectory:
    """The motion sampled from 0 to ``duration_us``, both included, at ``rate_hz``."""
    t_us = truth_times(duration_us, rate_hz)
    return Trajectory(t_us, motion.pose(t_us.double() * 1e-6))


def velocity(pose: PoseFunction, t_s: Float[Tensor, "q"]) -> Float[Tensor, "q 6"]:
    """Twists ``[rotation (rad/s), translation (m/s)]`` of ``dT/dt = ξ^ T`` at times in seconds, by central differences."""
    before, after = pose(t_s.double() - _HALF_STEP_S), pose(t_s.double() + _HALF_STEP_S)
    return lie.se3_log(after @ lie.se3_inverse(before)) / (2 * _HALF_STEP_S)
