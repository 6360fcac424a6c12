"""What the tracker remembers between windows, and what one window gives: both immutable."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.tracking.adaptation.learned_contours import LearnedContours
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.motion.model import MotionState


@dataclass(frozen=True)
class Probation:
    """Where to look for objects again, should what was found of them turn out to be wrong.

    Args:
        runs: which objects are on probation.
        evidence: for what was found of each, in windows.
        T_cam_obj, covariance: of the object before it was found.
    """

    runs: Bool[Tensor, "b"]
    evidence: Float[Tensor, "b"]
    T_cam_obj: Float[Tensor, "b 4 4"]
    covariance: Float[Tensor, "b 12 12"]

    @classmethod
    def none(cls, T_cam_obj: Float[Tensor, "b 4 4"], covariance: Float[Tensor, "b 12 12"]) -> "Probation":
        """Nothing on probation."""
        return cls(torch.zeros_like(T_cam_obj[:, 0, 0], dtype=torch.bool), torch.zeros_like(T_cam_obj[:, 0, 0]), T_cam_obj, covariance)


@dataclass(frozen=True)
class TrackerState:
    """Everything the tracker remembers between windows.

    Args:
        T_cam_obj: pose of each object at its stream's ``t_us`` (float64).
        velocity: rotation of each object and velocity of its centre, in the camera's axes (rad/s, m/s).
        acceleration: how they changed in the last window (rad/s², m/s²).
        covariance: of pose and velocity (float64), in the chart of :mod:`torchtrack.tracking.motion.model`.
        score: of the last window, :attr:`torchtrack.tracking.validation.scored_fit.Found.score`.
        usual_score: its running mean.
        full_share: of the moving contour, what events explain when the object is seen well: rises as fast, but falls slowly.
        full_gathered: the same of how far events near its contours are on them.
        full_count: matched observations when the object is seen well, likewise.
        full_apart: how far apart the directions of contours with events on them are then (:func:`tracking.validation.measures.directions_apart`).
        doubted_s: for how long, less the time it was not, the object has been in doubt of being elsewhere (s).
        T_last_seen: pose of each object when it was last seen well (float64).
        unseen_s: how long ago that was (s).
        darker_outside: which side of each object's contours is the darker one, by the octant that they face: :mod:`tracking.association.polarity`.
        late_share: how many of the events on its moving contours come late in their bursts: :mod:`torchtrack.tracking.adaptation.pixel_latency`.
        t_us: end of the last window of each stream (µs).
        last_event_us: time of the newest event of every sensor pixel (µs).
        burst_age_us: how long ago the newest burst of every sensor pixel and polarity began (µs).
        probation: which finds are not certain yet.
        learned: contours learned on the objects; none where that is switched off.
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    velocity: Float[Tensor, "b 6"]
    acceleration: Float[Tensor, "b 6"]
    covariance: Float[Tensor, "b 12 12"]
    score: Float[Tensor, "b"]
    usual_score: Float[Tensor, "b"]
    full_share: Float[Tensor, "b"]
    full_gathered: Float[Tensor, "b"]
    full_count: Float[Tensor, "b"]
    full_apart: Float[Tensor, "b"]
    doubted_s: Float[Tensor, "b"]
    T_last_seen: Float[Tensor, "b 4 4"]
    unseen_s: Float[Tensor, "b"]
    darker_outside: Float[Tensor, "b 8"]
    late_share: Float[Tensor, "b"]
    t_us: Int[Tensor, "s"]
    last_event_us: Int[Tensor, "s h w"]
    burst_age_us: Int[Tensor, "s 2 h w"]
    probation: Probation
    learned: LearnedContours | None = None

    @property
    def motion(self) -> MotionState:
        """What the motion model predicts from."""
        return MotionState(self.T_cam_obj, self.velocity, self.acceleration, self.covariance)

    def numbered(self, before: "TrackerState", more: int = 0) -> "TrackerState":
        """The state with as many windows taken as ``before``, and some more."""
        learned = self.learned
        if learned is not None and before.learned is not None:
            learned = replace(learned, windows=before.learned.windows + more)
        return replace(self, learned=learned)

    def without_maps(self) -> "TrackerState":
        """The state without what is known of every pixel of the sensors, which is most of it: to be looked at, not to go on from."""
        streams = len(self.t_us)
        return replace(self, last_event_us=self.last_event_us.new_empty(streams, 0, 0), burst_age_us=self.burst_age_us.new_empty(streams, 2, 0, 0))


@dataclass(frozen=True)
class StepResult:
    """What one window gave.

    Args:
        t_us: end of the window of each stream (µs).
        T_cam_obj: pose of each object at that time (float64).
        covariance: of the left perturbation ``[φ, ρ]`` of each pose (rad, m), with all that earlier windows told.
        status: :class:`torchtrack.tracking.validation.status.Status` of each object.
        quality: share of the moving contour that events explain.
        contours: visible contours at the pose.
        corners: corners and their flow, where the settings ask for any.
        observation_count: matched observations of each object.
    """

    t_us: Int[Tensor, "s"]
    T_cam_obj: Float[Tensor, "b 4 4"]
    covariance: Float[Tensor, "b 6 6"]
    status: Int[Tensor, "b"]
    quality: Float[Tensor, "b"]
    contours: Contours
    corners: Corners
    observation_count: Int[Tensor, "b"]


S = TypeVar("S", TrackerState, StepResult)
D = TypeVar("D")
# What belongs to streams; everything else belongs to objects.
_OF_STREAMS = ("t_us", "last_event_us", "burst_age_us")


def choose_rows(
    first: Bool[Tensor, "b"], of_first: tuple[TrackerState, StepResult], of_second: tuple[TrackerState, StepResult]
) -> tuple[TrackerState, StepResult]:
    """State and result of two ways to take the same window: of the first way for some objects, of the second for the others.

    What belongs to streams is the same in both, and taken from the second.
    """

    def of_objects(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(first.view(-1, *[1] * (one.dim() - 1)), one, other)

    results = (of_first[1], of_second[1])
    places = max(result.contours.mask.shape[1] for result in results)
    results_of_one_width = [replace(result, contours=result.contours.widened(places)) for result in results]
    state: TrackerState = _mapped(of_objects, lambda _, second: second, of_first[0], of_second[0])
    result: StepResult = _mapped(of_objects, lambda _, second: second, *results_of_one_width)
    return state, result


def take_part(value: S, objects: slice, streams: slice) -> S:
    """The state or the result of some objects and of the streams that they are in."""
    part: S = _mapped(lambda tensor: tensor[objects], lambda tensor: tensor[streams], value)
    return part


def each_tensor(change: Callable[[Tensor], Tensor], value: D) -> D:
    """The state, the result or another dataclass with each of its tensors changed, in order; or a tensor changed."""
    changed: D = _mapped(change, change, value)
    return changed


def joined(states: Sequence[TrackerState]) -> TrackerState:
    """One state of the objects and streams of several, one after the other."""
    state: TrackerState = _mapped(lambda *rows: torch.cat(rows), lambda *rows: torch.cat(rows), *states)
    return state


def _mapped(of_objects: Callable[..., Tensor], of_streams: Callable[..., Tensor], *values: Any) -> Any:
    """A dataclass with its tensors made from those of others of its kind: what belongs to objects, and what belongs to streams."""
    if not is_dataclass(values[0]):
        # What is switched off, or a mere number, is the same for all.
        return of_objects(*values) if torch.is_tensor(values[0]) else values[0]
    kind: Any = type(values[0])
    made = {}
    for field in fields(kind):
        inner = [getattr(value, field.name) for value in values]
        made[field.name] = of_streams(*inner) if field.name in _OF_STREAMS else _mapped(of_objects, of_streams, *inner)
    return kind(**made)
