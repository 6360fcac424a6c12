"""What is learned of objects while they are tracked: contours that their models lack."""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.tracking.adaptation.surface_learning import Surroundings, learn_after
from torchtrack.tracking.association.polarity import expected_polarity, is_asked
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.validation.scored_fit import Found
from torchtrack.tracking.validation.status import Status


def objects_as_known(objects: ObjectBatch, state: TrackerState, on_surfaces: bool, config: TrackerConfig) -> ObjectBatch:
    """The objects with the contours learned on them that count by now.

    Where less is seen of any than usual, they know which side of their contours is the darker one.

    Args:
        on_surfaces: whether contours can be learned on any object.
    """
    if state.learned is not None and on_surfaces:
        counting = state.learned.that_count(config.learning)
        if not host_sync.none_of(counting.mask):
            objects = replace(objects, learned=counting)
    if config.matching.polarity_memory_s:
        explained = state.score.detach(), state.full_share.detach()
        if not host_sync.none_of(is_asked(*explained)):
            objects = replace(objects, polarity=expected_polarity(state.darker_outside, *explained))
    return objects


@dataclass(frozen=True)
class Lesson:
    """A window to learn from.

    Args:
        events: of the window.
        window_s: its duration, for each object.
        sigma_px: standard deviation of each object's prediction in the image: of an uncertain one nothing is learned.
        on_surfaces: on which objects contours can be learned; None where on none.
        learns: whether anything is learned, and not only looked whether there is need to.
    """

    events: ObjectEvents
    window_s: Float[Tensor, "b"]
    sigma_px: Float[Tensor, "b"]
    on_surfaces: Bool[Tensor, "b"] | None
    learns: bool = True


def learned_after(
    state: TrackerState, result: StepResult, prediction: Prediction, found: Found, lesson: Lesson, config: TrackerConfig
) -> TrackerState:
    """The state after a window with what was learned in it.

    Args:
        prediction: of the objects, before the window.
        found: what ``state`` and ``result`` stand on.
    """
    learned = state.learned
    if learned is None or lesson.on_surfaces is None:
        return state
    trusted = (result.status <= int(Status.UNCERTAIN)) & (lesson.sigma_px < config.learning.max_sigma_px)
    T_cam_obj = state.T_cam_obj.to(lesson.sigma_px.dtype)
    around = Surroundings(prediction.objects, T_cam_obj, state.velocity, lesson.window_s, result.contours, trusted)
    wanted = learned.wanted(lesson.on_surfaces, config.learning) if lesson.learns else None
    return replace(state, learned=learn_after(learned, around, found, lesson.events, wanted, config))


def learns_next(state: TrackerState, on_surfaces: Bool[Tensor, "b"] | None, config: TrackerConfig) -> bool:
    """Whether contours are learned in the window after ``state``."""
    if state.learned is None or on_surfaces is None:
        return False
    wanted = state.learned.wanted(on_surfaces, config.learning)
    return wanted is not None and host_sync.AsyncValue.to(wanted).any()
