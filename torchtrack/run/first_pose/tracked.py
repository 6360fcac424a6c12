"""Poses at the start, followed through the first windows: the one that goes on to explain events best is the first pose.

All are tracked as one batch, each in a stream of its own. The best is then followed back to the start, with the events in reverse
(:mod:`torchtrack.run.retracing`), and so the pose is of the time that was asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.presets import preset
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.windows import EventWindow, windows_by_time
from torchtrack.run.first_pose.parts import Parts, finished
from torchtrack.run.first_pose.start import Start
from torchtrack.run.retracing import followed_back
from torchtrack.tracking.initialization import first_state
from torchtrack.tracking.state import TrackerState, take_part
from torchtrack.tracking.tracker import Tracker

# How long poses are followed (µs); what is explained at the end of it, for the last part of the windows, is compared.
FOLLOWED_US, _COMPARED = 60_000, 0.5


@dataclass(frozen=True)
class FirstPose:
    """A pose at the start.

    Args:
        T_cam_obj: the pose (float64).
        at_us: its time.
        quality: share of the moving contour that events explained, in the last windows it was followed through.
    """

    T_cam_obj: Float[Tensor, "4 4"]
    at_us: int
    quality: float


@dataclass(frozen=True)
class Followed:
    """What a pose came to in the windows it was followed through.

    Args:
        state: after them, of a tracker of the object alone.
        windows: that it was followed through.
        quality: share of the moving contour that events explained, in the last of them.
    """

    state: TrackerState
    windows: Sequence[EventWindow]
    quality: float


def best_followed(start: Start, T_cam_obj: Float[Tensor, "n 4 4"]) -> FirstPose:
    """The pose that explains most of what comes after the start.

    Args:
        start: with events in the first ``FOLLOWED_US``.
        T_cam_obj: poses to choose from, each near enough to be tracked from there if it is the right one.
    """
    best = finished(followed_on(start, T_cam_obj))
    with torch.inference_mode():
        *_, (at_start, _) = followed_back(best.state, 0, best.windows, alone(start))
    return FirstPose(at_start.T_cam_obj[0].clone(), start.at_us, best.quality)


def followed_on(start: Start, T_cam_obj: Float[Tensor, "n 4 4"]) -> Parts[Followed]:
    """Of some poses at the start, what the one comes to that explains most of what comes after."""
    config, count = alone_config(), len(T_cam_obj)
    windows = list(windows_by_time([start.events.slice_time(start.at_us, start.at_us + FOLLOWED_US)], config.window.duration_us, start.at_us))
    tracker = Tracker([start.model] * count, [start.camera] * count, config, range(count))
    state = first_state(tracker, T_cam_obj.double(), torch.full((count,), start.at_us))
    scores, explained = [], []
    for window in windows:
        with torch.inference_mode():
            state, result = tracker.step(state, _for_all(window.events, count), window.t_end_us)
        scores.append(state.health.score)
        # A pose whose contours are few may explain them all, and yet less of the events than another one.
        explained.append(state.health.score * result.observation_count)
        yield
    last = max(1, round(_COMPARED * len(scores)))
    score, events = (torch.stack(values[-last:]).mean(0) for values in (scores, explained))
    best = int(events.argmax())
    return Followed(take_part(state, slice(best, best + 1), slice(best, best + 1)), windows, float(score[best]))


def alone(start: Start) -> Tracker:
    """A tracker of the object alone, that looks for no other poses."""
    return Tracker([start.model], start.camera, alone_config())


def alone_config() -> TrackerConfig:
    """The usual settings, without a search for other poses: these are all tried as it is."""
    return preset("causal").without_searches()


def _for_all(events: EventBatch, count: int) -> EventBatch:
    return concatenate([events.of_stream(stream) for stream in range(count)])
