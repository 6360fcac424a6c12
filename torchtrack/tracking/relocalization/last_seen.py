"""Where an object may be that is not where it is predicted: drifted off, or as it was last seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.contours.objects import ObjectBatch, copied_rows
from torchtrack.tracking.motion.model import covariance_at_rest, rim_and_centre
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import TrackerState

# How fast an object may have drifted off (px/s), and, if it is small in the image (diameters/s); the slower counts. Not measured alone.
_DRIFT_PX_S, _DRIFT_DIAMETERS_S = 200.0, 1.5
# An object is not looked for farther away than it can have drifted in this time (s), nor rotated farther than in this.
_LONGEST_S, _LONGEST_ROTATION_S = 0.4, 1.0


def with_drift(prediction: Prediction, is_adrift: Bool[Tensor, "b"], drift_s: Float[Tensor, "b"]) -> Prediction:
    """The prediction, of objects that drift so uncertain as if they had moved otherwise, at some constant velocity, for that long."""
    objects = prediction.objects
    speed_m_s = torch.minimum(_DRIFT_PX_S / objects.px_per_m(prediction.T_cam_obj), _DRIFT_DIAMETERS_S * objects.diameter_m).double()
    # Covariances are constants, also where gradients are recorded.
    speed_m_s = speed_m_s.detach()
    velocity = rim_and_centre(speed_m_s[:, None], objects.diameter_m.double()[:, None])
    rotated_s, moved_s = (drift_s.clamp(max=longest_s).double()[:, None].expand(-1, 3) for longest_s in (_LONGEST_ROTATION_S, _LONGEST_S))
    # Pose and velocity are off together: such a velocity explains both.
    pose, rate = (torch.diag_embed(part) for part in (velocity * torch.cat([rotated_s, moved_s], 1), velocity))
    root = torch.cat([pose, rate], 1)
    return replace(prediction, covariance=prediction.covariance + is_adrift[:, None, None] * (root @ root.mT))


def less_certain(prediction: Prediction, sigma_px: Float[Tensor, "k"], wider_px: Float[Tensor, "k"]) -> Prediction:
    """The prediction as if its standard deviation in the image, ``sigma_px``, were ``wider_px``.

    A pose that slipped was sure of itself all the while: its covariance tells the directions it can be off in, but not how far.
    """
    times = (wider_px.double() / sigma_px.double().clamp(min=1e-6)).square()
    return replace(prediction, covariance=prediction.covariance * times[:, None, None])


# Standard deviations: rotation (rad), and depth (as a share of it).
_ROTATION_RAD, _DEPTH_SHARE = 1.0, 0.1


# And way across the image (px/s, and as a share of its diagonal), the longer the object was not seen well.
_SPEED_PX_S, _DIAGONALS = 400.0, 0.2


# One look after the other: as far as in a third of all that, in two, in all. A few hundred poses come near the right one but rarely in all.
_LOOKS = 3


@dataclass(frozen=True)
class LastSeen:
    """Where objects are expected that nothing else is known of.

    Args:
        T_cam_obj: their poses when they were last seen well (float64).
        covariance: of pose and velocity, in the chart of :mod:`torchtrack.tracking.motion.model` (float64).
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    covariance: Float[Tensor, "b 12 12"]

    @classmethod
    def from_state(cls, state: TrackerState, objects: ObjectBatch, config: TrackerConfig) -> "LastSeen":
        """Poses as they were, as uncertain as each object's next look asks for."""
        T_cam_obj = state.health.T_last_validated.to(objects.intrinsics.dtype)
        fraction = (state.health.looks % _LOOKS + 1).double() / _LOOKS
        diagonal_px = objects.image_sizes.double().norm(dim=-1)
        across_px = (_SPEED_PX_S * state.health.time_since_validated_s.double()).clamp(max=_DIAGONALS * diagonal_px)
        across_m, depth_m = across_px / objects.px_per_m(T_cam_obj).double(), _DEPTH_SHARE * objects.depth_m(T_cam_obj).double()
        rotation_rad = torch.full_like(depth_m, _ROTATION_RAD)
        pose = fraction[:, None] * torch.stack([rotation_rad, rotation_rad, rotation_rad, across_m, across_m, depth_m], 1)
        return cls(state.health.T_last_validated, covariance_at_rest(pose, objects.diameter_m, config.motion))

    def in_place_of(self, state: TrackerState, lost: Bool[Tensor, "b"]) -> TrackerState:
        """The state with objects that are ``lost`` at rest where they were last seen well."""
        return replace(state, motion=state.motion.at_rest(lost, self.T_cam_obj, self.covariance))

    def prediction(self, numbers: Sequence[int], prediction: Prediction) -> Prediction:
        """The prediction of some objects, at rest there."""
        some = prediction.copies(numbers)
        T_cam_obj, covariance = (copied_rows(values, numbers) for values in (self.T_cam_obj, self.covariance))
        return Prediction(some.objects, T_cam_obj.to(some.T_cam_obj.dtype), torch.ones_like(some.usable), torch.zeros_like(some.velocity), covariance)


def anywhere(covariance: Float[Tensor, "b 12 12"], chosen: Bool[Tensor, "b"]) -> Float[Tensor, "b 12 12"]:
    """Covariances of poses and velocities, of the ``chosen`` objects so large that they may be anywhere in the image."""
    unknown = torch.eye(12, dtype=covariance.dtype, device=covariance.device)
    return torch.where(chosen[:, None, None], unknown, covariance)
