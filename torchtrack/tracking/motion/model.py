"""How objects are expected to move from one window to the next: a constant velocity, disturbed by accelerations.

Pose and velocity of each object have a joint covariance, in the chart of :func:`torchtrack.core.lie.retract_about`:
``[rotation, move of the centre, angular velocity, velocity of the centre]``. It is the prediction of an iterated Kalman
filter: what a window's events say is weighed against it direction by direction, so that what they hold well follows
them, and what they hardly see (an edge that moves along itself, depth) goes on as it moved before.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import MotionConfig

# A prediction is not let grow less certain than this (rad, and diameters).
MOST_UNCERTAIN = 0.5


# A motion that no events confirm dies away with this time constant (s). Not measured alone.
COAST_S = 0.2
# A turn that events hardly show dies away with this time constant (s), not to run away. Not measured alone.
TURN_S = 0.2


@dataclass(frozen=True)
class MotionState:
    """Pose and motion of each object at its stream's time, and how certain they are.

    Args:
        T_cam_obj: poses (float64).
        velocity: rotation of each object and velocity of its centre, in the camera's axes (rad/s, m/s).
        covariance: of pose and velocity (float64), in the chart that this file describes.
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    velocity: Float[Tensor, "b 6"]
    covariance: Float[Tensor, "b 12 12"]

    def at_rest(self, chosen: Bool[Tensor, "b"], T_cam_obj: Float[Tensor, "b 4 4"], covariance: Float[Tensor, "b 12 12"]) -> "MotionState":
        """The same with the ``chosen`` objects at rest at other poses, as uncertain as that."""
        return MotionState(
            T_cam_obj=torch.where(chosen[:, None, None], T_cam_obj, self.T_cam_obj),
            velocity=torch.where(chosen[:, None], 0, self.velocity),
            covariance=torch.where(chosen[:, None, None], covariance, self.covariance),
        )


def initial_covariance(diameter_m: Float[Tensor, "b"], config: MotionConfig) -> Float[Tensor, "b 12 12"]:
    """Covariance of a pose that is given, and of a velocity that is not known (float64)."""
    wide_m = diameter_m.double()[:, None]
    return covariance_at_rest(rim_and_centre(config.initial_shift * wide_m, wide_m), diameter_m, config)


def covariance_at_rest(pose_sigma: Float[Tensor, "b 6"], diameter_m: Float[Tensor, "b"], config: MotionConfig) -> Float[Tensor, "b 12 12"]:
    """Covariance of a pose with these standard deviations (rad, m), and of a velocity that is not known (float64)."""
    wide_m = diameter_m.double()[:, None]
    rate = rim_and_centre(torch.full_like(wide_m, config.initial_speed_m_s), wide_m)
    return torch.diag_embed(torch.cat([pose_sigma, rate], -1).square())


def rim_and_centre(way_m: Float[Tensor, "b 1"], diameter_m: Float[Tensor, "b 1"]) -> Float[Tensor, "b 6"]:
    """A way of the object's rim and of its centre (m): three rotations (rad) and three translations (m); or a speed, likewise."""
    return torch.cat([(2 * way_m / diameter_m).expand(-1, 3), way_m.expand(-1, 3)], -1)


def predict_covariance(
    covariance: Float[Tensor, "b 12 12"],
    velocity: Float[Tensor, "b 6"],
    dt_s: Float[Tensor, "b"],
    diameter_m: Float[Tensor, "b"],
    config: MotionConfig,
) -> Float[Tensor, "b 12 12"]:
    """Covariance after ``dt_s`` of constant velocity, with an acceleration that is constant over it (float64).

    How much acceleration is to be expected grows with the speed: slow objects are held still, fast ones are free to turn.
    """
    dt_s, diameter_m, velocity = dt_s.double()[:, None], diameter_m.double()[:, None], velocity.double()
    # [[1, dt], [0, 1]] P [[1, 0], [dt, 1]], by blocks.
    carried = torch.cat([torch.addcmul(covariance[:, :6], dt_s[..., None], covariance[:, 6:]), covariance[:, 6:]], 1)
    carried = torch.cat([torch.addcmul(carried[..., :6], dt_s[..., None], carried[..., 6:]), carried[..., 6:]], 2)
    # An acceleration adds half its square of the time to the pose, and its time to the velocity.
    acceleration = acceleration_sigma(velocity, diameter_m, config)
    push = torch.cat([0.5 * dt_s.square() * acceleration, dt_s * acceleration], -1).view(-1, 2, 6)
    predicted = carried + torch.diag_embed(push[:, :, None] * push[:, None]).permute(0, 1, 3, 2, 4).reshape(-1, 12, 12)
    sigma = predicted.diagonal(dim1=-2, dim2=-1).sqrt()
    lost = (sigma[:, :3] > MOST_UNCERTAIN).any(-1) | (sigma[:, 3:6] > MOST_UNCERTAIN * diameter_m).any(-1)
    return torch.where(lost[:, None, None], covariance, predicted)


def acceleration_sigma(velocity: Float[Tensor, "b 6"], diameter_m: Float[Tensor, "b 1"], config: MotionConfig) -> Float[Tensor, "b 6"]:
    """Standard deviation of the acceleration to be expected (rad/s², m/s²)."""
    rim_m_s = velocity[:, 3:].norm(dim=-1, keepdim=True) + 0.5 * diameter_m * velocity[:, :3].norm(dim=-1, keepdim=True)
    return rim_and_centre(config.acceleration_rate_hz * rim_m_s + config.acceleration_floor_m_s2, diameter_m)


def fade(velocity: Float[Tensor, "b 6"], dt_s: Float[Tensor, "b"], failed: Bool[Tensor, "b"]) -> Float[Tensor, "b 6"]:
    """Velocities where nothing confirmed them: a coasting object must not leave for good."""
    return torch.where(failed[:, None], velocity * torch.exp(-dt_s / COAST_S)[:, None], velocity)


def expected_velocity(velocity: Float[Tensor, "b 6"], dt_s: Float[Tensor, "b"]) -> Float[Tensor, "b 6"]:
    """The velocity after ``dt_s``, before any acceleration: turns die away slowly (an Ornstein-Uhlenbeck process).

    Events that show a turn hold it up: what dies away in a window is a quarter of the change that is to be expected in it.
    One that hardly any show, because what would is hidden, feeds on the facets of the mesh, and would grow.
    """
    turning, moving = velocity.split(3, 1)
    return torch.cat([turning * torch.exp(-dt_s / TURN_S)[:, None], moving], 1)


def with_dropped(covariance: Float[Tensor, "b 12 12"], dropped: Float[Tensor, "b 6"]) -> Float[Tensor, "b 12 12"]:
    """Covariance where part of the velocity was set aside: it is uncertain by that much."""
    dropped = torch.nn.functional.pad(dropped.to(covariance.dtype), (6, 0))
    return covariance + dropped[:, :, None] * dropped[:, None]
