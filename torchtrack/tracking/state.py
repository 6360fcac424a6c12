"""What the tracker remembers between windows, and what one window gives: both immutable."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.field_values import field_values
from torchtrack.core.later import Later
from torchtrack.tracking.adaptation.appearance import Appearance
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.motion.model import MotionState
from torchtrack.tracking.validation.health import TrackHealth
from torchtrack.tracking.validation.status import Status

# Of more objects than this, the others are counted.
_MOST_SHOWN = 4


@dataclass(frozen=True, repr=False)
class TrackerState:
    """Everything the tracker remembers between windows, in parts that belong to the rooms that use them.

    Args:
        t_us: end of the last window of each stream (µs).
        motion: pose and motion of each object at that time.
        health: how well each object is seen.
        appearance: what was learned of how objects look.
        maps: what is remembered of every pixel of the sensors.
        search: that goes on beside the windows, of all objects; none where searches are waited for. No part of the state has it.
    """

    t_us: Int[Tensor, "s"]
    motion: MotionState
    health: TrackHealth
    appearance: Appearance
    maps: SensorMaps
    search: "Search | None" = None

    def __repr__(self) -> str:
        return f"TrackerState({_times(self.t_us)}, positions {_positions(self.T_cam_obj)}, {self.T_cam_obj.device})"

    @property
    def T_cam_obj(self) -> Float[Tensor, "b 4 4"]:  # noqa: N802 - frames have their letters
        """Pose of each object (float64)."""
        return self.motion.T_cam_obj

    @property
    def velocity(self) -> Float[Tensor, "b 6"]:
        """Rotation of each object and velocity of its centre, in the camera's axes (rad/s, m/s)."""
        return self.motion.velocity

    def numbered(self, before: "TrackerState", more: int = 0) -> "TrackerState":
        """The state with as many windows taken as ``before``, and some more."""
        learned, earlier = self.appearance.learned, before.appearance.learned
        if learned is None or earlier is None:
            return self
        learned = replace(learned, windows=earlier.windows + more)
        return replace(self, appearance=replace(self.appearance, learned=learned))

    def without_maps(self) -> "TrackerState":
        """The state without what is known of every pixel of the sensors, which is most of it: to be looked at, not to go on from."""
        streams, maps = len(self.t_us), self.maps
        empty = SensorMaps(maps.last_event_us.new_empty(streams, 0, 0), maps.burst_age_us.new_empty(streams, 2, 0, 0))
        return replace(self, maps=empty, search=None)


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        judged = zip(self.status[:_MOST_SHOWN].tolist(), self.quality[:_MOST_SHOWN].tolist(), strict=True)
        statuses = ", ".join(f"{Status(status).name} {quality:.2f}" for status, quality in judged)
        return f"StepResult({_times(self.t_us)}, {statuses}{_more(self.status)}, positions {_positions(self.T_cam_obj)})"


@dataclass(frozen=True)
class Answer:
    """What came of a search.

    Args:
        looked: objects that other poses were tried for.
        is_unconfirmed: those of which no more was asked than whether another pose explains far more.
        relocalized: state and result of each object that was found, by its number, as a tracker of it alone has them.
    """

    looked: Bool[Tensor, "b"]
    is_unconfirmed: Bool[Tensor, "b"]
    relocalized: Mapping[int, tuple[TrackerState, StepResult]]


@dataclass(frozen=True)
class Search:
    """A search that goes on beside the windows.

    Args:
        since_us: end of the window that it is of, of each stream (µs).
        triggers: what objects asked for that the search is not of.
        answer: what came of it, followed through the windows since; none where no search goes on.
        kind: the triggers that the last search was of.
    """

    since_us: Int[Tensor, "s"]
    triggers: Int[Tensor, "b"]
    answer: Later[Answer] | None = None
    kind: int = 0


def _times(t_us: Int[Tensor, "s"]) -> str:
    return f"{', '.join(str(time) for time in t_us[:_MOST_SHOWN].tolist())}{_more(t_us)} µs"


def _positions(T_cam_obj: Float[Tensor, "b 4 4"]) -> str:
    rows = T_cam_obj[:_MOST_SHOWN, :3, 3].tolist()
    return f"{', '.join('(' + ', '.join(f'{value:.3f}' for value in row) + ')' for row in rows)}{_more(T_cam_obj)} m"


def _more(values: Tensor) -> str:
    return f" and {len(values) - _MOST_SHOWN} more" if len(values) > _MOST_SHOWN else ""


S = TypeVar("S", TrackerState, StepResult)
D = TypeVar("D")
# What belongs to streams; everything else belongs to objects.
_OF_STREAMS = ("t_us", "last_event_us", "burst_age_us")
# What belongs to all objects together: no part has it, and nothing that is made of parts.
_OF_ALL = ("search",)


def choose_rows(
    first: Bool[Tensor, "b"], of_first: tuple[TrackerState, StepResult], of_second: tuple[TrackerState, StepResult]
) -> tuple[TrackerState, StepResult]:
    """State and result of two ways to take the same window: of the first way for some objects, of the second for the others.

    What belongs to streams is the same in both, and taken from the second.
    """

    def of_objects(first_rows: Tensor, second_rows: Tensor) -> Tensor:
        return torch.where(first.view(-1, *[1] * (first_rows.dim() - 1)), first_rows, second_rows)

    state: TrackerState = _mapped(of_objects, lambda _, second: second, of_first[0], of_second[0])
    result: StepResult = _mapped(of_objects, lambda _, second: second, *of_one_width(of_first[1], of_second[1]))
    return state, result


def of_one_width(*results: StepResult) -> list[StepResult]:
    """The results with as many places for contours in each."""
    places = max(result.contours.mask.shape[1] for result in results)
    return [replace(result, contours=result.contours.widened(places)) for result in results]


def take_part(value: S, objects: slice, streams: slice) -> S:
    """The state or the result of some objects and of the streams that they are in."""
    part: S = _mapped(lambda tensor: tensor[objects], lambda tensor: tensor[streams], value)
    return part


def each_tensor(change: Callable[[Tensor], Tensor], value: D) -> D:
    """The state, the result or another dataclass with each of its tensors changed, in order; or a tensor changed."""
    changed: D = _mapped(change, change, value)
    return changed


def put_object(number: int, of_all: tuple[TrackerState, StepResult], alone: tuple[TrackerState, StepResult]) -> tuple[TrackerState, StepResult]:
    """State and result of all objects, with one of them as a tracker of it alone has it."""

    def put(rows: Tensor, row: Tensor) -> Tensor:
        changed = rows.clone()
        changed[number] = row[0]
        return changed

    own_corners = take_part(of_all[1], slice(number, number + 1), slice(0)).corners
    results = of_one_width(of_all[1], replace(alone[1], corners=own_corners))
    state: TrackerState = _mapped(put, lambda rows, _: rows, of_all[0], alone[0])
    result: StepResult = _mapped(put, lambda rows, _: rows, *results)
    return replace(state, search=of_all[0].search), result


def joined(states: Sequence[TrackerState]) -> TrackerState:
    """One state of the objects and streams of several, one after the other."""
    state: TrackerState = _mapped(lambda *rows: torch.cat(rows), lambda *rows: torch.cat(rows), *states)
    return state


def _mapped(of_objects: Callable[..., Tensor], of_streams: Callable[..., Tensor], *values: Any) -> Any:
    """A dataclass with its tensors made from those of others of its kind: what belongs to objects, and what belongs to streams."""
    if torch.is_tensor(values[0]):
        return of_objects(*values)
    # What is switched off, or a mere number, is the same for all.
    if values[0] is None or not is_dataclass(values[0]):
        return values[0]
    kind: Any = type(values[0])
    made = {}
    for name in field_values(values[0]):
        inner = [getattr(value, name) for value in values]
        if name in _OF_ALL:
            continue
        made[name] = of_streams(*inner) if name in _OF_STREAMS else _mapped(of_objects, of_streams, *inner)
    return kind(**made)
