"""Stage 1 of a window: where the objects are expected at its end, and which events can have to do with them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch, pad_streams
from torchtrack.tracking.adapt import objects_as_known
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.sensors import farthest_event_px
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.initialization import held_back
from torchtrack.tracking.motion.predict import forecast
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.relocalization.evidence import Schedule
from torchtrack.tracking.relocalization.last_seen import LastSeen, anywhere
from torchtrack.tracking.relocalization.schedule import may_look_far, schedule
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, DRIFTS, Trigger, has
from torchtrack.tracking.state import Search, TrackerState

# What objects are looked for by farther away than they are expected.
_FAR = AROUND_LAST_SEEN | DRIFTS | Trigger.UNCONFIRMED


@dataclass(frozen=True)
class Expected:
    """Where objects are expected at a window's end.

    Args:
        prediction: with gradients, where they are recorded.
        window_s: length of the window, of each stream (s).
        dt_s: the same, of each object.
        scheduled: what relocalization has to do with the window, as far as the state says.
    """

    prediction: Prediction
    window_s: Float[Tensor, "s"]
    dt_s: Float[Tensor, "b"]
    scheduled: Schedule


def expect(tracked: TrackedObjects, state: TrackerState, events: EventBatch, t_us: Int[Tensor, "s"], reads: host_sync.HostReads) -> Expected:
    """Where objects are expected at a window's end: objects that are lost for long, where they were last seen well.

    Args:
        events: of the window that ends at ``t_us``.
        reads: asks for what has to be decided.
    """
    window_s = _seconds_after(tracked, state, t_us)
    dt_s, objects = window_s[tracked.stream_index], tracked.objects
    scheduled = schedule(state, objects, t_us, tracked.config)
    lost = has(scheduled.triggers, Trigger.LOST)
    # Most windows are of objects that were found long ago: their events need not be counted, where that is known at once.
    never_found = ~(state.health.mean_score > 0)
    if tracked.config.uses(Component.SPEED_FROM_EVENTS) and not reads.none_of(never_found):
        state = held_back(state, never_found, objects, tracked.sensors.seen(pad_streams(events, tracked.streams, t_us)), dt_s)
    if not reads.none_of(lost):
        state = LastSeen.from_state(state, objects, tracked.config).in_place_of(state, lost)
    return Expected(predicted_after(tracked, state, dt_s, objects), window_s, dt_s, scheduled)


def predicted_after(tracked: TrackedObjects, state: TrackerState, dt_s: Float[Tensor, "b"], objects: ObjectBatch | None = None) -> Prediction:
    """Predicted pose and motion of each object after a time, and how certain they are; ``objects`` are the tracked ones as a batch, where at hand."""
    config = tracked.config
    objects = objects_as_known(objects or tracked.objects, state, tracked.on_surfaces is not None, config)
    return forecast(state.motion, dt_s, objects, tracked.far_pose, config)


def near_objects(tracked: TrackedObjects, state: TrackerState, expected: Expected, events: NearbyEvents, last: Search | None = None) -> NearbyEvents:
    """Those of the events that can have to do with the objects: any, for objects that may be looked for anywhere.

    A weighting network of one's own is shown all.

    Args:
        last: the last search, where searches go on beside the windows: while it does, nobody else is looked for.
    """
    if tracked.shows_all:
        return events
    prediction, far = expected.prediction.detached(), may_look_far(state, expected.scheduled, tracked.config)
    if last is not None:
        far = torch.zeros_like(far) if last.answer is not None else far | has(last.triggers, _FAR)
    if not host_sync.none_of(far):
        prediction = replace(prediction, covariance=anywhere(prediction.covariance, far))
    return tracked.sensors.near_objects(events, prediction, expected.dt_s, tracked.config)


def near_tiles(tracked: TrackedObjects, state: TrackerState, t_us: Int[Tensor, "s"]) -> Bool[Tensor, "b t"]:
    """Tiles with events of the window after ``state`` that can have to do with each object where it is expected."""
    dt_s = _seconds_after(tracked, state, t_us)[tracked.stream_index]
    return tracked.tiles.near(predicted_after(tracked, state, dt_s), dt_s, farthest_event_px(tracked.config))


def _seconds_after(tracked: TrackedObjects, state: TrackerState, t_us: Int[Tensor, "s"]) -> Float[Tensor, "s"]:
    """Length of the window after ``state`` that ends at ``t_us``, of each stream (s)."""
    return (t_us - state.t_us).to(tracked.intrinsics.dtype) * 1e-6
