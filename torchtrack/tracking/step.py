"""One window of a tracker, from its events to poses: :func:`advance` calls the six stages in their order, and each is a function below."""

from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch
from torchtrack.core.later import Later
from torchtrack.tracking.adapt import Lesson, learned_after
from torchtrack.tracking.association.claimed_events import UNSEEN_FROM_S, claimed_pixels, without_claimed
from torchtrack.tracking.association.flow_agreement import guided_by_flow
from torchtrack.tracking.association.observations import Observations, corner_observations, select_events
from torchtrack.tracking.association.weighting_features import WeightingInputs, judged
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import Fit, Start, align, gate_scale_of, index_for, index_radius, usual_index_radius, widest_index_radius
from torchtrack.tracking.estimation.terms import CostTerm
from torchtrack.tracking.expectation import Expected, expect, near_objects
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.flow import estimate_flow
from torchtrack.tracking.frontend.sensor_view import SensorPoints
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.frontend.time_surface import update_last_event
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.initialization import of_unknown_motion
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.relocalization.evidence import TriggerEvidence, gather_evidence
from torchtrack.tracking.relocalization.last_seen import LastSeen
from torchtrack.tracking.relocalization.lost_objects import Relocalized
from torchtrack.tracking.relocalization.relocalize import relocalize
from torchtrack.tracking.relocalization.triggers import SEARCHED, Trigger, has, next_kind, triggered
from torchtrack.tracking.state import Answer, Search, StepResult, TrackerState, each_tensor, take_part
from torchtrack.tracking.update import conclude
from torchtrack.tracking.validation.measures import required_spread
from torchtrack.tracking.validation.scored_fit import ScoredFit, explained_at_rest, reference_where_known, score_fit
from torchtrack.tracking.validation.verdict import Limits, confirmed_status


@dataclass(frozen=True)
class StepInput:
    """What a step is given beside the state.

    Args:
        events: of the window, as far as they can have to do with the objects.
        t_us: end of the window, of each stream.
        is_starting: objects whose motion is not known yet; none where not given.
        reads: asks for what has to be decided.
        learns: whether anything may be learned from the window.
        extra_terms: of the cost, beside contours and prediction.
        search: the last one, where searches go on beside the windows; none where they are waited for.
    """

    events: NearbyEvents
    t_us: Int[Tensor, "s"]
    is_starting: Bool[Tensor, "b"] | None = None
    reads: host_sync.HostReads = field(default_factory=host_sync.HostReads)
    learns: bool = True
    extra_terms: tuple[CostTerm, ...] = ()
    search: Search | None = None


@dataclass(frozen=True)
class Observed:
    """What a window shows of the objects.

    Args:
        events: as each object sees them.
        burst_age_us: the sensors' map of bursts after the window.
        contours: visible where the objects are expected, and ``index`` of them.
        sigma_px: standard deviation of each object's prediction in the image.
        gate_scale: how many times wider than configured the first gate of each object is.
        corners: corners and their flow, where the settings ask for any.
        observations: what is matched with the contours, each with how far it is to be believed.
    """

    events: ObjectEvents
    burst_age_us: Int[Tensor, "s 2 h w"]
    contours: Contours
    index: ContourIndex
    sigma_px: Float[Tensor, "b"]
    gate_scale: Float[Tensor, "b"]
    corners: Corners
    observations: Observations


@dataclass(frozen=True)
class SteadyWindow:
    """What a window gave for all objects, before any of them is looked for elsewhere.

    Args:
        expected, seen: of the window.
        scored: the fits.
        evidence: for relocalization, with the triggers of each object.
    """

    expected: Expected
    seen: Observed
    scored: ScoredFit
    evidence: TriggerEvidence

    @property
    def located(self) -> Relocalized:
        """The same with nothing relocalized."""
        return Relocalized(self.scored, self.expected.prediction, self.seen.gate_scale)


def advance(tracked: TrackedObjects, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult]:
    """A window from its events to poses.

    Args:
        tracked: the objects, cameras and settings.
        state: from :func:`opened`.
        given: the window.
    """
    window = steady_window(tracked, state, given)
    if given.search is not None:
        return _searched_later(tracked, state, window, given, given.search)
    # A GPU is waited for: a pose that begins to slip is farther off a window later.
    searches = given.reads.ask(has(window.evidence.triggers, SEARCHED), False).any()
    return update(tracked, state, window, relocalized(tracked, state, window) if searches else window.located, given)


def _searched_later(
    tracked: TrackedObjects, state: TrackerState, window: SteadyWindow, given: StepInput, last: Search
) -> tuple[TrackerState, StepResult]:
    """State and result of a window with nobody looked for, and with a search that objects ask for, by now or since they asked and are not well."""
    evidence, limits = window.evidence, Limits.from_config(tracked.config)
    is_well = (evidence.time_since_validated_s == 0) & (evidence.confirmations >= limits.confirmed_by)
    triggers = evidence.triggers | torch.where(is_well, 0, last.triggers)
    next_state, result = update(tracked, state, window, window.located, given)
    if host_sync.none_of(has(triggers, SEARCHED)):
        return next_state, result
    kind = next_kind(triggers, last.kind)
    window = replace(window, evidence=replace(evidence, triggers=triggers & (kind | ~int(SEARCHED))))
    answer = Later(partial(_answer, tracked, state, window, replace(given, search=None)))
    return replace(next_state, search=Search(given.t_us, triggers, answer, kind)), result


@torch.no_grad()
def _answer(tracked: TrackedObjects, state: TrackerState, window: SteadyWindow, given: StepInput) -> Answer:
    """What comes of the search that a window asks for, with each object that it finds as if it had been tracked alone."""
    located = relocalized(tracked, state, window)
    taken = update(tracked, state, window, located, given)
    looked = torch.zeros_like(located.scored.is_relocalized) if located.looked is None else located.looked
    alone = {}
    for number in (looked & located.scored.is_relocalized).nonzero()[:, 0].tolist():
        stream = int(tracked.stream_index[number])
        own = slice(number, number + 1), slice(stream, stream + 1)
        alone[number] = take_part(taken[0], *own), take_part(taken[1], *own)
    return Answer(looked, has(window.evidence.triggers, Trigger.UNCONFIRMED), alone)


def steady_window(tracked: TrackedObjects, state: TrackerState, given: StepInput) -> SteadyWindow:
    """Stages 1 to 4, of all objects alike, and which of them have triggers."""
    expected = expect(tracked, state, given.events.events, given.t_us, given.reads)
    seen = observe(tracked, state, expected, given)
    start = Start(expected.prediction, seen.contours, seen.index, seen.gate_scale, extra_terms=given.extra_terms)
    scored = validate(tracked, state, expected, seen, align(start, seen.observations, tracked.config))
    is_starting = torch.zeros_like(tracked.stream_index, dtype=torch.bool) if given.is_starting is None else given.is_starting
    evidence = triggered(gather_evidence(state, expected.scheduled, scored, seen.sigma_px, is_starting), tracked.config)
    if given.is_starting is not None:
        # A part of a window is taken for the objects that start: what the others come to in it is not kept.
        evidence = replace(evidence, triggers=torch.where(is_starting, evidence.triggers, 0))
    return SteadyWindow(expected, seen, scored, evidence)


def observe(tracked: TrackedObjects, state: TrackerState, expected: Expected, given: StepInput) -> Observed:
    """Stage 2: events, corners and flow near the objects, and the contours that they are matched with."""
    config, sensors, maps, t_us = tracked.config, tracked.sensors, state.maps, given.t_us
    prediction, nearby = expected.prediction.detached(), near_objects(tracked, state, expected, given.events, given.search)
    events, burst_age_us = sensors.window_events(nearby, maps.burst_age_us, t_us, t_us - state.t_us)
    contours = prediction.objects.contours(prediction.T_cam_obj, config.contours)
    sigma_px = prediction.sigma_px(contours).detach() if config.solver.prior else torch.zeros_like(tracked.diameter_m)
    gate_scale = gate_scale_of(sigma_px, config)
    # Asked for here: a GPU answers while corners are looked for.
    radius_px = given.reads.ask_within(index_radius(gate_scale, config), usual_index_radius(config), widest_index_radius(config))
    view = sensors.view(replace(maps, burst_age_us=burst_age_us), t_us)
    corners = sensors.corners(contours, view, expected.window_s, config)
    if config.association.search == "along_flow":
        flow, has_flow = estimate_flow(corners.points, view, config.flow)
        corners = replace(corners, flow=flow, has_flow=has_flow)
    events = unclaimed(tracked, state, expected, events, contours, given.reads)
    index = index_for(contours, tracked.image_size, config, gate_scale, radius_px)
    observations, most = corner_observations(corners), config.association.max_events
    if most:
        observations = select_events(events, index, prediction.moving(compensated=True), most, observations)
    if tracked.weighting_network is not None:
        history = sensors.history(maps.last_event_us, t_us)
        observations = judged(WeightingInputs(observations, events, prediction, contours, index, history), tracked.weighting_network)
    if config.association.search == "guided":
        points = SensorPoints(sensors.nearest_pixels(observations.pixels), observations.age_s, observations.polarity, observations.mask)
        flow, has_flow = estimate_flow(points, view, config.flow)
        observations = replace(observations, flow=flow, has_flow=has_flow)
        observations = guided_by_flow(observations, index, contours, prediction, state.health.time_since_validated_s)
        # Corners are in their places; in those that they leave, there are events.
        own = slice(corners.mask.shape[1])
        corners = replace(corners, flow=flow[:, own] * corners.mask[..., None], has_flow=has_flow[:, own] & corners.mask)
    return Observed(events, burst_age_us, contours, index, sigma_px, gate_scale, corners, observations)


def unclaimed(
    tracked: TrackedObjects, state: TrackerState, expected: Expected, events: ObjectEvents, contours: Contours, reads: host_sync.HostReads
) -> ObjectEvents:
    """The events; of objects that are not seen well, without those that others explain which are."""
    prediction, is_unseen = expected.prediction.detached(), state.health.time_since_validated_s >= UNSEEN_FROM_S
    if not (prediction.objects.shared and tracked.config.uses(Component.OTHERS_EVENTS)) or reads.none_of(is_unseen):
        return events
    is_seen_well = ~is_unseen & (state.health.mean_score > 0)
    claimed = claimed_pixels(prediction, contours, is_seen_well, expected.dt_s)
    return without_claimed(events, claimed, tracked.stream_index, is_unseen)


def validate(tracked: TrackedObjects, state: TrackerState, expected: Expected, seen: Observed, fit: Fit) -> ScoredFit:
    """Stage 4, after the alignment: what each pose explains of its contours, and of the events around them."""
    config, health = tracked.config, state.health
    reference = reference_where_known(seen.sigma_px, health.reference_inlier_ratio, config.relocalization)
    spread = required_spread(health.reference_normal_spread, health.time_since_validated_s, config)
    return score_fit(expected.prediction.detached(), fit, config, explained_at_rest(seen.gate_scale), reference, spread)


def relocalized(tracked: TrackedObjects, state: TrackerState, window: SteadyWindow) -> Relocalized:
    """Stage 5: other poses for objects that have a trigger, and for no others."""
    last_seen = LastSeen.from_state(state, tracked.objects, tracked.config)
    return relocalize(window.located, window.evidence, window.seen.events, last_seen, tracked.config)


def update(
    tracked: TrackedObjects, state: TrackerState, window: SteadyWindow, located: Relocalized, given: StepInput
) -> tuple[TrackerState, StepResult]:
    """Stage 6: the filter's update, statuses, and what is learned."""
    config, expected, seen = tracked.config, window.expected, window.seen
    scored, prediction = located.scored, located.prediction.detached()
    next_state, result = conclude(state, located, seen.corners, expected.dt_s, config)
    lesson = Lesson(seen.events, expected.dt_s, seen.sigma_px, tracked.on_surfaces, learns=given.learns)
    next_state = learned_after(next_state, result, prediction, scored, lesson, config)
    limits, health, looked = Limits.from_config(config), next_state.health, located.looked
    health = health.with_looks(None) if looked is None else health.after_looks(looked, has(window.evidence.triggers, Trigger.UNCONFIRMED), limits)
    status = confirmed_status(result.status, health.confirmations, limits)
    maps = replace(next_state.maps, burst_age_us=seen.burst_age_us)
    return replace(next_state, t_us=given.t_us, maps=maps, health=health), replace(result, t_us=given.t_us, status=status)


def opened(tracked: TrackedObjects, state: TrackerState, events: EventBatch) -> TrackerState:
    """The state with the newest events of a window in its map, where they are remembered."""
    if not tracked.looks_back:
        return state
    return replace(state, maps=replace(state.maps, last_event_us=update_last_event(state.maps.last_event_us, events)))


def steady_advance(
    tracked: TrackedObjects, state: TrackerState, events: NearbyEvents, t_us: Int[Tensor, "s"]
) -> tuple[TrackerState, StepResult, Bool[Tensor, ""]]:
    """:func:`advance` with nothing to decide and nothing learned; and whether anything was, or the window may be called for in parts."""
    steady = host_sync.SteadyState()
    steady.ask(of_unknown_motion(state, t_us, tracked.objects, tracked.config), False)
    return *advance(tracked, state, StepInput(events, t_us, reads=steady, learns=False)), steady.wrong()


def steady_lane(
    tracked: TrackedObjects, state: TrackerState, events: NearbyEvents, t_us: Int[Tensor, "s"], *, learns: bool = False
) -> tuple[TrackerState, StepResult, Bool[Tensor, "2"], SteadyWindow]:
    """:func:`steady_advance` that holds however uncertain or lost objects are: what these need is done for all, and nobody is looked for.

    Returns:
        State; result; whether the window may be called for in parts, and so does not hold, and whether anybody is to be looked for; and the window
        itself, for :func:`looked_for`.
    """
    reads = host_sync.UncertainState()
    reads.ask(of_unknown_motion(state, t_us, tracked.objects, tracked.config), False)
    given = StepInput(events, t_us, reads=reads, learns=learns)
    window = steady_window(tracked, state, given)
    stated = torch.stack([reads.wrong(), has(window.evidence.triggers, SEARCHED).any()])
    return *update(tracked, state, window, window.located, given), stated, window


def looked_for(
    tracked: TrackedObjects, state: TrackerState, window: SteadyWindow, events: NearbyEvents, t_us: Int[Tensor, "s"], *, learns: bool
) -> tuple[TrackerState, StepResult]:
    """State and result of a window of :func:`steady_lane`, with those looked for that have triggers: as :func:`advance` gives them."""
    given = StepInput(events, t_us, learns=learns)
    next_state, result = update(tracked, state, window, relocalized(tracked, state, window), given)
    # What it passes on is in the graph's memory.
    return each_tensor(Tensor.clone, next_state), each_tensor(Tensor.clone, result)
