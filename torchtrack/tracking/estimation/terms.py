"""What the solver is given of each object, observations and prior, and what it gives back."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class WindowTerms:
    """What observations tell of beside the pose, which the solver then finds with it.

    An observation that is older than the pose tells of the velocity: the two are found together, so that a velocity
    that was predicted wrong neither biases the pose nor is learned one window late. And all limbs of an object may stand
    out of its outline, or within it, by one unknown way, as smooth shading makes them: without it, depth would be
    believed to be seen far better than it is.

    Args:
        age_s: time from each observation to the pose (s).
        velocity: offset from the predicted velocity that the targets were moved with (rad/s, m/s).
        outward: 1 where the outline's swelling counts along the direction, 0 where not.
        rate_hz: acceleration in the window for each unit of velocity beyond the predicted one (1/s); zero where it is the same all along.
    """

    age_s: Float[Tensor, "b n"]
    velocity: Float[Tensor, "b 6"]
    outward: Float[Tensor, "b n"]
    rate_hz: Float[Tensor, "b 6"]


@dataclass(frozen=True)
class PoseProblem:
    """Observations and prior of each object.

    Args:
        points_obj: matched contour points in the object's frame (m).
        targets: ideal pixels where they were observed.
        directions: unit directions along which the distance counts.
        weights: weight of each observation; 0 for padding.
        intrinsics: ``[fx, fy, cx, cy]``.
        centre_obj: centre of rotation in the object's frame (m).
        scale_px: scale of the robust loss, per object.
        T_prior: pose the prior draws to.
        prior_information: information of the prior in the solver's chart; zero for no prior.
        window: further unknowns; then the chart is ``[pose 6, velocity 6, swelling (px) 1]`` instead of the pose alone.
    """

    points_obj: Float[Tensor, "b n 3"]
    targets: Float[Tensor, "b n 2"]
    directions: Float[Tensor, "b n 2"]
    weights: Float[Tensor, "b n"]
    intrinsics: Float[Tensor, "b 4"]
    centre_obj: Float[Tensor, "b 3"]
    scale_px: Float[Tensor, "b"]
    T_prior: Float[Tensor, "b 4 4"]
    prior_information: Float[Tensor, "b k k"]
    window: WindowTerms | None = None


@dataclass(frozen=True)
class Linearisation:
    """The problem at a pose, in the solver's chart.

    Args:
        T_cam_obj: the pose.
        gradient, hessian: of the robust cost, prior included; the Hessian is Gauss-Newton's.
        from_prior: offset from the prior: rotation and move of the centre, and the further unknowns where there are.
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    gradient: Float[Tensor, "b k"]
    hessian: Float[Tensor, "b k k"]
    from_prior: Float[Tensor, "b k"]
