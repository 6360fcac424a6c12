"""Errors of poses against ground truth, as the paper measures them: δR in degrees, δT in centimetres."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.io import Trajectory
from torchtrack.lie import rotation_angle_deg


@dataclass(frozen=True)
class PoseErrors:
    """Errors of one object, one per window.

    Args:
        t_us: ``[p]`` int64, ends of the windows.
        rotation_deg: ``[p]`` angle between the estimated and the true rotation.
        translation_cm: ``[p]`` distance between the estimated and the true position of the object's origin.
    """

    t_us: Int[Tensor, "p"]
    rotation_deg: Float[Tensor, "p"]
    translation_cm: Float[Tensor, "p"]


def pose_errors(t_us: Int[Tensor, "p"], T_cam_obj: Float[Tensor, "p 4 4"], truth: Trajectory) -> PoseErrors:
    """Errors at the times ``t_us``, with the truth interpolated on SE(3); times that the truth does not cover are left out."""
    covered = (t_us >= truth.t_us[0]) & (t_us <= truth.t_us[-1])
    t_us, estimated = t_us[covered], T_cam_obj[covered].double()
    true = truth.at(t_us)
    return PoseErrors(
        t_us,
        rotation_angle_deg(estimated[:, :3, :3], true[:, :3, :3]),
        100 * (estimated[:, :3, 3] - true[:, :3, 3]).norm(dim=-1),
    )


_NAN = float("nan")
_NOTHING = (_NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN)


@dataclass(frozen=True)
class Metrics:
    """Errors of one object over a whole sequence; all NaN where no window has a truth."""

    windows: int
    mean_rotation_deg: float
    mean_translation_cm: float
    median_rotation_deg: float
    median_translation_cm: float
    max_rotation_deg: float
    max_translation_cm: float
    lost_fraction: float

    def as_dict(self) -> dict[str, Any]:
        """Name to value."""
        return asdict(self)


def summarise(errors: PoseErrors, lost_rotation_deg: float = 10.0, lost_translation_cm: float = 5.0) -> Metrics:
    """Mean, median and maximum over all windows, and the share of them whose rotation or translation is off by more than the limits."""
    rotation, translation = errors.rotation_deg.numpy(), errors.translation_cm.numpy()
    if len(rotation) == 0:
        return Metrics(0, *_NOTHING)
    # A pose that is not finite is as lost as can be, and must not pass a comparison.
    lost = ~((rotation <= lost_rotation_deg) & (translation <= lost_translation_cm))
    return Metrics(
        windows=len(rotation),
        mean_rotation_deg=float(rotation.mean()),
        mean_translation_cm=float(translation.mean()),
        median_rotation_deg=float(np.median(rotation)),
        median_translation_cm=float(np.median(translation)),
        max_rotation_deg=float(rotation.max()),
        max_translation_cm=float(translation.max()),
        lost_fraction=float(lost.mean()),
    )
