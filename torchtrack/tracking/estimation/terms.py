"""What a pose is drawn to. The cost is a sum of terms; each says of a place how far off it is, and how that changes with a step.

Two terms are in every problem: the distances of observations from contours, and the prior. A further one is a frozen dataclass
with the method :meth:`CostTerm.linearise`, in a file of its own, and is passed as one of ``extra_terms`` to
:meth:`torchtrack.tracking.tracker.Tracker.step`, :func:`torchtrack.tracking.estimation.rounds.align` or a :class:`PoseProblem`.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.image_velocity import pose_jacobian
from torchtrack.core.lie import affine, turned


@dataclass(frozen=True)
class Place:
    """A place in the space of unknowns: the pose as a rotation and the place of the centre, and the offset from the prior.

    A point ``p`` of the object is at ``rotation @ (p - centre_obj) + centre_cam`` in the camera's frame.
    """

    rotation: Float[Tensor, "b 3 3"]
    centre_cam: Float[Tensor, "b 3 1"]
    from_prior: Float[Tensor, "b k"]

    @classmethod
    def at(cls, T_cam_obj: Float[Tensor, "b 4 4"], centre_obj: Float[Tensor, "b 3"], from_prior: Float[Tensor, "b k"]) -> "Place":
        """The place of a pose."""
        rotation = T_cam_obj[:, :3, :3]
        return cls(rotation, affine(rotation, centre_obj[..., None], T_cam_obj[:, :3, 3:]), from_prior)

    def moved(self, step: Float[Tensor, "b k"]) -> "Place":
        """The place that a step leads to: steps add up to the offset from the prior, to second order."""
        return Place(turned(self.rotation, step[:, :3]), self.centre_cam + step[:, 3:6, None], self.from_prior + step)

    def pose(self, problem: "PoseProblem") -> Float[Tensor, "b 4 4"]:
        """The pose as a matrix."""
        translation = torch.baddbmm(self.centre_cam, self.rotation, problem.centre_obj[..., None], alpha=-1)
        return torch.cat([torch.cat([self.rotation, translation], 2), problem.T_prior[:, 3:]], 1)


@dataclass(frozen=True)
class LinearisedTerm:
    """A term of the cost at a place.

    Args:
        residuals: how far off each quantity is.
        rows: derivative of each residual by the unknowns, in the solver's chart ``[rotation 3 (rad), centre 3 (m), ...]``: by all of
            them, or by the first ones where the rest does not move it. None where the residuals are the unknowns' offsets themselves.
        weights: of each residual, 0 for padding; with ``rows`` None the residuals' information matrix.
        scale: at which the solver's robust loss bends, in units of the residuals; None where squares count as they are.
    """

    residuals: Float[Tensor, "b n"]
    rows: Float[Tensor, "b j n"] | None
    weights: Float[Tensor, "b n"] | Float[Tensor, "b n n"]
    scale: Float[Tensor, "b"] | None = None


@runtime_checkable
class CostTerm(Protocol):
    """One term of the cost: a frozen dataclass.

    Its tensors are its fields, or those of dataclasses among them, with the objects' axis first: what is differentiated through a
    solution is repeated with them in float64.
    """

    def linearise(self, place: Place) -> LinearisedTerm:
        """The term at a place. It has to be differentiable by the place, and an object's residuals hang on that object alone."""


@dataclass(frozen=True)
class WindowTerms:
    """What observations tell of beside the pose, which the solver then finds with it.

    An observation that is older than the pose tells of the velocity: the two are found together, so that a velocity
    that was predicted wrong neither biases the pose nor is learned one window late.

    Args:
        age_s: time from each observation to the pose (s).
        velocity: offset from the predicted velocity that the targets were moved with (rad/s, m/s).
    """

    age_s: Float[Tensor, "b n"]
    velocity: Float[Tensor, "b 6"]


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
        window: further unknowns; then the chart is ``[pose 6, velocity 6]`` instead of the pose alone.
        extra_terms: of the cost, beside contour distances and prior.
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
    extra_terms: tuple[CostTerm, ...] = ()

    def terms(self) -> tuple[CostTerm, ...]:
        """All terms of the cost, in the order in which the solver adds them up."""
        return ContourDistance.from_problem(self), Prior(self.prior_information), *self.extra_terms


@dataclass(frozen=True)
class ContourDistance:
    """Distances (px) of matched contour points from their targets, along one direction each.

    Laid out for speed: a row per component, so that every operation runs along contiguous observations. The residual is
    ``slope · (x/z, y/z) - offset``.

    Args:
        arms: the points as seen from the object's centre (m).
        slope: the direction times the focal lengths.
        offset: the target's place along the direction (px).
        weights: weight of each observation; 0 for padding.
        scale_px: scale of the robust loss.
        window: further unknowns, where there are.
    """

    arms: Float[Tensor, "b 3 n"]
    slope: Float[Tensor, "b 2 n"]
    offset: Float[Tensor, "b n"]
    weights: Float[Tensor, "b n"]
    scale_px: Float[Tensor, "b"]
    window: WindowTerms | None

    @classmethod
    def from_problem(cls, problem: PoseProblem) -> "ContourDistance":
        """The constant parts of a problem, laid out by component."""
        directions = problem.directions.transpose(1, 2)
        focal, principal = problem.intrinsics[:, :2, None], problem.intrinsics[:, 2:, None]
        offset = ((problem.targets.transpose(1, 2) - principal) * directions).sum(1)
        arms = (problem.points_obj.transpose(1, 2) - problem.centre_obj[..., None]).contiguous()
        return cls(arms, directions * focal, offset, problem.weights.to(offset.dtype), problem.scale_px, problem.window)

    def linearise(self, place: Place) -> LinearisedTerm:
        """Project the matched points, and take residuals and gradients ``g = dπᵀ n`` of them."""
        arms = affine(place.rotation, self.arms)
        x, y, z = (arms + place.centre_cam).unbind(1)
        inverse_depth = z.clamp(min=MIN_DEPTH_M).reciprocal()
        gx, gy = (self.slope * inverse_depth[:, None]).unbind(1)
        along = torch.addcmul(gx * x, gy, y)
        jacobian = pose_jacobian(arms, (gx, gy, (along * inverse_depth).neg_()))
        residuals = along - self.offset
        if self.window is None:
            return LinearisedTerm(residuals, jacobian, self.weights, self.scale_px)
        # Linear in all that is unknown beside the pose; the targets have been moved with one velocity already.
        further = jacobian * -self.window.age_s[:, None]
        unexpected = (place.from_prior[:, 6:] - self.window.velocity)[:, None]
        residuals = torch.baddbmm(residuals[:, None], unexpected, further)[:, 0]
        return LinearisedTerm(residuals, torch.cat([jacobian, further], 1), self.weights, self.scale_px)


@dataclass(frozen=True)
class Prior:
    """The offset of all unknowns from what was predicted.

    Args:
        information: of the prediction, in the solver's chart; zero for no prior.
    """

    information: Float[Tensor, "b k k"]

    def linearise(self, place: Place) -> LinearisedTerm:
        """The offset, as it is."""
        return LinearisedTerm(place.from_prior, None, self.information)


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
