"""What is learned of objects while they are tracked: contours that their models lack, and parts of the models that are not seen."""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.tracking.adaptation.model_trust import judge_elements
from torchtrack.tracking.adaptation.surface_learning import Surroundings, learn_after
from torchtrack.tracking.association.polarity import expected_polarity, is_asked
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.validation.scored_fit import Found
from torchtrack.tracking.validation.status import Status


def objects_as_known(
    objects: ObjectBatch, state: TrackerState, element_groups: Int[Tensor, "b k"], on_surfaces: bool, config: TrackerConfig
) -> ObjectBatch:
    """The objects with the contours learned on them that count by now, and without those parts of their models that are not seen.

    Where less is seen of any than usual, they know which side of their contours is the darker one.

    Args:
        element_groups: the group of each element of the objects' models.
        on_surfaces: whether contours can be learned on any object.
    """
    if state.learned is not None and on_surfaces:
        counting = state.learned.that_count(config.learning)
        if not host_sync.none_of(counting.mask):
            objects = replace(objects, learned=counting)
    if state.model_trust is not None:
        shown = state.model_trust.of_width(element_groups.shape[1]).shown(element_groups, config.model_trust)
        if not host_sync.read_at_once(shown) or not bool(shown.all()):
            objects = replace(objects, shown=shown)
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
    trust, learned = state.model_trust, state.learned
    is_judged = lesson.learns and trust is not None and trust.due(config.model_trust)
    if not is_judged and (learned is None or lesson.on_surfaces is None):
        return state
    trusted = (result.status <= int(Status.UNCERTAIN)) & (lesson.sigma_px < config.learning.max_sigma_px)
    fitted = replace(prediction, T_cam_obj=state.T_cam_obj.to(lesson.sigma_px.dtype), velocity=state.velocity)
    if trust is not None and is_judged:
        trust = judge_elements(trust, fitted, lesson.window_s, lesson.events.rows(), trusted, config)
    if learned is not None and lesson.on_surfaces is not None:
        taken_share = None if trust is None else trust.taken_share
        around = Surroundings(fitted.objects, fitted.T_cam_obj, fitted.velocity, lesson.window_s, result.contours, trusted, taken_share)
        wanted = learned.wanted(lesson.on_surfaces, config.learning) if lesson.learns else None
        learned = learn_after(learned, around, found, lesson.events, wanted, config)
    return replace(state, model_trust=trust, learned=learned)


def due_lessons(state: TrackerState, on_surfaces: Bool[Tensor, "b"] | None, config: TrackerConfig) -> tuple[bool, bool] | None:
    """Which lessons the window after ``state`` is for: of the model's parts, of contours that it lacks; None where nothing is to be learned."""
    learned, trust = state.learned, state.model_trust
    is_judged = trust is not None and trust.due(config.model_trust)
    wanted = None if learned is None or on_surfaces is None else learned.wanted(on_surfaces, config.learning)
    if is_judged or (wanted is not None and host_sync.Answer.to(wanted).any()):
        return is_judged, wanted is not None
    return None
