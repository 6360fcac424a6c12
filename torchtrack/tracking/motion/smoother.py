"""Poses refined by what came after them: a smoother behind the tracker's filter (Rauch, Tung and Striebel 1965).

The pose of a window stands on the events up to its end. Those of the windows after it tell of it, too: where it moved on
to, and how fast. What is refined comes later for it, so this is for recordings, and for whoever can wait.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import MotionConfig
from torchtrack.core.lie import difference_about, retract_about
from torchtrack.core.linalg import inverse
from torchtrack.tracking.motion.model import predict_covariance

# Squared distance (12 degrees of freedom) from what was to be expected above which an object was found in another place: what
# came before is not dragged there. Of what the filter holds for possible, 2 in 100 million are farther.
_FARTHEST = 60.0


@dataclass(frozen=True)
class Filtered:
    """What is known of objects at the ends of consecutive windows (float64).

    Args:
        t_us: ends of the windows, ascending (µs).
        T_cam_obj: poses.
        velocity: rotation, and velocity of the centre (rad/s, m/s).
        covariance: of pose and velocity, in the chart of :mod:`torchtrack.tracking.motion.model`.
    """

    t_us: Int[Tensor, "n"]
    T_cam_obj: Float[Tensor, "n b 4 4"]
    velocity: Float[Tensor, "n b 6"]
    covariance: Float[Tensor, "n b 12 12"]


@dataclass(frozen=True)
class _Link:
    """From each window to the next.

    Args:
        off: how far pose and velocity at the next one's end turned out to be off what was expected before that one's events.
        covariance, information: of what was expected, and its inverse.
        gain: what a window's pose and velocity gain by each unit that those of the next one are off.
    """

    off: Float[Tensor, "m b 12"]
    covariance: Float[Tensor, "m b 12 12"]
    information: Float[Tensor, "m b 12 12"]
    gain: Float[Tensor, "m b 12 12"]


def goes_on(filtered: Filtered, centre_obj: Float[Tensor, "b 3"], diameter_m: Float[Tensor, "b"], config: MotionConfig) -> Bool[Tensor, "m b"]:
    """Whether each object was found, in each window but the first, where the one before led to expect it; arguments as :func:`smoothed`."""
    link = _link(filtered, centre_obj, diameter_m, config)
    return _goes_on(link.off[..., None], link.information)[..., 0, 0]


def smoothed(filtered: Filtered, centre_obj: Float[Tensor, "b 3"], diameter_m: Float[Tensor, "b"], config: MotionConfig) -> Filtered:
    """The same windows, each with what all of them tell of it; the last one as it is.

    Motions are taken to be of constant velocity, disturbed by accelerations as the filter expects them; what dies away in
    its prediction (turns, coasting) does so slowly, and is left out. An object that was found too far from where it was
    to be expected says nothing of the windows before.

    Args:
        filtered: from the tracker.
        centre_obj: centre of each object (m).
        diameter_m: diameter of each object.
        config: with the accelerations that the filter expects.
    """
    if len(filtered.t_us) < 2:
        return filtered
    link = _link(filtered, centre_obj, diameter_m, config)
    step, covariance = torch.zeros_like(link.off[0]), filtered.covariance[-1]
    steps, covariances = [step], [covariance]
    for k in reversed(range(len(link.off))):
        off = (link.off[k] + step)[..., None]
        same_motion = _goes_on(off, link.information[k])
        # Chosen, not multiplied: what is not a number would stay.
        gain, off, less = (torch.where(same_motion, values, 0) for values in (link.gain[k], off, covariance - link.covariance[k]))
        step, covariance = (gain @ off)[..., 0], filtered.covariance[k] + gain @ less @ gain.mT
        steps.append(step)
        covariances.append(covariance)
    by, faster = torch.stack(steps[::-1]).split(6, -1)
    T_cam_obj = retract_about(filtered.T_cam_obj, by, centre_obj.expand(len(steps), -1, 3))
    return Filtered(filtered.t_us, T_cam_obj, filtered.velocity + faster, torch.stack(covariances[::-1]))


def _goes_on(off: Float[Tensor, "*m b 12 1"], information: Float[Tensor, "*m b 12 12"]) -> Bool[Tensor, "*m b 1 1"]:
    """Whether what was found so far off what was expected may be the same motion, going on."""
    return off.mT @ information @ off < _FARTHEST


def _link(filtered: Filtered, centre_obj: Tensor, diameter_m: Tensor, config: MotionConfig) -> _Link:
    """What the filter expected of each window but the first."""
    before = [values[:-1].flatten(0, 1) for values in (filtered.T_cam_obj, filtered.velocity, filtered.covariance)]
    (T_cam_obj, velocity, covariance), shape = before, filtered.velocity[:-1].shape[:2]
    dt_s = (1e-6 * filtered.t_us.diff().double()).repeat_interleave(shape[1])
    centres, diameters = centre_obj.repeat(shape[0], 1), diameter_m.repeat(shape[0])
    expected = predict_covariance(covariance, velocity, dt_s, diameters, config)
    information = inverse(expected)
    # The covariance of a window with the one after it: P Fᵀ, with F = [[1, dt], [0, 1]].
    across = torch.cat([torch.addcmul(covariance[..., :6], dt_s[:, None, None], covariance[..., 6:]), covariance[..., 6:]], 2)
    T_expected = retract_about(T_cam_obj, velocity * dt_s[:, None], centres)
    off = torch.cat([difference_about(T_expected, filtered.T_cam_obj[1:].flatten(0, 1), centres), filtered.velocity[1:].flatten(0, 1) - velocity], 1)
    return _Link(*(values.unflatten(0, shape) for values in (off, expected, information, across @ information)))
