"""Errors of poses against ground truth, as the paper measures them: δR in degrees, δT in centimetres."""

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.lie import rotation_angle_deg
from torchtrack.io import Trajectory
from torchtrack.object_model.symmetry import RevolutionAxis


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


def pose_errors(t_us: Int[Tensor, "p"], T_cam_obj: Float[Tensor, "p 4 4"], truth: Trajectory, axis: RevolutionAxis | None = None) -> PoseErrors:
    """Errors at the times ``t_us``, with the truth interpolated on SE(3); times that it does not cover, and gaps in it, are left out.

    A turn about the ``axis`` of a surface of revolution is no error, since nothing shows it: of all poses that look the
    same, the one nearest to the truth is compared (as in Hodan et al., "BOP: benchmark for 6D object pose estimation", 2018).
    """
    covered = truth.covers(t_us)
    t_us, estimated = t_us[covered], T_cam_obj[covered].double()
    true = truth.at(t_us)
    if axis is not None:
        estimated = axis.turned_to_match(estimated, true)
    return PoseErrors(
        t_us,
        rotation_angle_deg(estimated[:, :3, :3], true[:, :3, :3]),
        100 * (estimated[:, :3, 3] - true[:, :3, 3]).norm(dim=-1),
    )


# After this long a tracker has found its motion: what it errs by then is its own (µs).
SETTLING_US = 50_000


@dataclass(frozen=True)
class Metrics:
    """Errors of one object over a whole sequence; NaN where no window has a truth.

    The peaks are the largest error after the first 50 ms, by the mean: a tracker that never slips has small ones.
    """

    windows: int
    mean_rotation_deg: float
    mean_translation_cm: float
    median_rotation_deg: float
    median_translation_cm: float
    max_rotation_deg: float
    max_translation_cm: float
    lost_fraction: float
    peak_rotation: float
    peak_translation: float

    def as_dict(self) -> dict[str, Any]:
        """Name to value."""
        return asdict(self)


def is_lost(errors: PoseErrors, lost_rotation_deg: float, lost_translation_cm: float) -> Bool[np.ndarray, "p"]:
    """Of each window whether its rotation or translation is off by more than the limits."""
    # A pose that is not finite is as lost as can be, and must not pass a comparison.
    return ~((errors.rotation_deg.numpy() <= lost_rotation_deg) & (errors.translation_cm.numpy() <= lost_translation_cm))


def summarise(errors: PoseErrors, lost_rotation_deg: float = 10.0, lost_translation_cm: float = 5.0) -> Metrics:
    """Mean, median and maximum over all windows, and the share of them whose rotation or translation is off by more than the limits."""
    rotation, translation = errors.rotation_deg.numpy(), errors.translation_cm.numpy()
    if len(rotation) == 0:
        return Metrics(0, **dict.fromkeys((field.name for field in fields(Metrics)[1:]), float("nan")))
    lost = is_lost(errors, lost_rotation_deg, lost_translation_cm)
    settled = errors.t_us.numpy() >= int(errors.t_us[0]) + SETTLING_US
    return Metrics(
        windows=len(rotation),
        mean_rotation_deg=float(rotation.mean()),
        mean_translation_cm=float(translation.mean()),
        median_rotation_deg=float(np.median(rotation)),
        median_translation_cm=float(np.median(translation)),
        max_rotation_deg=float(rotation.max()),
        max_translation_cm=float(translation.max()),
        lost_fraction=float(lost.mean()),
        peak_rotation=_peak(rotation, settled),
        peak_translation=_peak(translation, settled),
    )


def _peak(error: np.ndarray, settled: np.ndarray) -> float:
    """The largest settled error, by the mean of all; NaN where nothing is settled or nothing errs."""
    mean = float(error.mean())
    return float(error[settled].max()) / mean if settled.any() and mean > 0 else float("nan")
