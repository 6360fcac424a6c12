"""What is learned of objects while they are tracked: contours that their models lack."""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.tracking.adaptation.surface_learning import Surroundings, learn_after
from torchtrack.tracking.association.polarity import expected_polarity, is_asked, remembers_polarity
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.status import Status

# Nothing is learned while the standard deviation of the prediction in the image is larger (px). Not measured alone.
_MAX_SIGMA_PX = 2.0


def objects_as_known(objects: ObjectBatch, state: TrackerState, on_surfaces: bool, config: TrackerConfig) -> ObjectBatch:
    """The objects with the contours learned on them that count by now.

    Where less is seen of any than usual, they know which side of their contours is the darker one.

    Args:
        on_surfaces: whether contours can be learned on any object.
    """
    appearance = state.appearance
    if appearance.learned is not None and on_surfaces:
        counting = appearance.learned.that_count()
        if not host_sync.none_of(counting.mask):
            objects = replace(objects, learned=counting)
    if remembers_polarity(config):
        explained = state.health.score.detach(), state.health.reference_explained_ratio.detach()
        if not host_sync.none_of(is_asked(*explained)):
            objects = replace(objects, polarity=expected_polarity(appearance.darker_outside, *explained))
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
    state: TrackerState, result: StepResult, prediction: Prediction, scored: ScoredFit, lesson: Lesson, config: TrackerConfig
) -> TrackerState:
    """The state after a window with what was learned in it.

    Args:
        prediction: of the objects, before the window.
        scored: what ``state`` and ``result`` stand on.
    """
    learned = state.appearance.learned
    if learned is None or lesson.on_surfaces is None:
        return state
    trusted = (result.status <= int(Status.UNCERTAIN)) & (lesson.sigma_px < _MAX_SIGMA_PX)
    T_cam_obj = state.T_cam_obj.to(lesson.sigma_px.dtype)
    around = Surroundings(prediction.objects, T_cam_obj, state.velocity, lesson.window_s, result.contours, trusted)
    wanted = learned.wanted(lesson.on_surfaces) if lesson.learns else None
    learned = learn_after(learned, around, scored, lesson.events, wanted, config)
    return replace(state, appearance=replace(state.appearance, learned=learned))


def learns_next(state: TrackerState, on_surfaces: Bool[Tensor, "b"] | None, config: TrackerConfig) -> bool:
    """Whether contours are learned in the window after ``state``."""
    learned = state.appearance.learned
    if learned is None or on_surfaces is None:
        return False
    wanted = learned.wanted(on_surfaces)
    return wanted is not None and host_sync.AsyncValue.to(wanted).any()
