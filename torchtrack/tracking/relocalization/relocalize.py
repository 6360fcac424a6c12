"""The loop of relocalization: for each object with a trigger, each source that the trigger calls for; propose, refine, accept."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.host_sync import AsyncValue
from torchtrack.tracking.estimation.rounds import gate_scale_of
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.acceptance import Acceptance
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.last_seen import LastSeen, with_drift
from torchtrack.tracking.relocalization.looks import Asks, among, in_turn
from torchtrack.tracking.relocalization.lost_object import LostObject, Relocalized
from torchtrack.tracking.relocalization.refine import exchanged, refined
from torchtrack.tracking.relocalization.sources import SOURCES, Source
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, DRIFTS, Trigger, has


def relocalize(
    window: Relocalized,
    evidence: TriggerEvidence,
    events: ObjectEvents,
    last_seen: LastSeen,
    config: TrackerConfig,
    sources: Sequence[Source] = SOURCES,
) -> Relocalized:
    """Try other poses for objects with triggers, as many of them as a window has looks for, and take those that pass the tests of their sources.

    Args:
        window: what it gave so far.
        evidence: with the triggers of each object.
        events: of all objects.
        last_seen: where objects were validated for the last time.
        sources: of hypotheses, in the order in which they are tried.
    """
    triggers = evidence.triggers
    tests = [source.test(evidence, window.scored, config) for source in sources]
    drifts = has(triggers, DRIFTS)
    drift_s = torch.where(has(triggers, Trigger.SLOW_DRIFT), evidence.time_since_validated_s, evidence.drift_s)
    widened = with_drift(window.prediction, drifts, drift_s)
    sigma_px = torch.where(drifts, widened.sigma_px(window.scored.fit.contours).detach(), evidence.sigma_px)
    # Without events no pose is better than another; what is looked for all around may have its own there.
    enough = events.counts() >= config.validation.min_observations
    evidence = replace(evidence, triggers=torch.where(enough, triggers, triggers & int(AROUND_LAST_SEEN)))
    asking = _asking(window, evidence, sources)
    looks = in_turn(asking, config.relocalization.objects)
    window = replace(window, looked=among([asks.number for asks in looks], drifts))
    sigmas_px = AsyncValue.to(sigma_px).numbers()
    for comes_last in (False, True):
        for asks in looks:
            number = asks.number
            calls = [pair for pair in zip(sources, tests, strict=True) if pair[0].comes_last == comes_last and pair[0].is_called_for(asks.flags)]
            if calls:
                lost = LostObject(number, window, widened, sigmas_px[number], events.of_object(number), last_seen, config)
                window = _tried(lost, calls)
        if not comes_last:
            window = _settled(window, drifts, widened, gate_scale_of(sigma_px, config))
    return window


def _asking(window: Relocalized, evidence: TriggerEvidence, sources: Sequence[Source]) -> list[Asks]:
    """The objects that a source is called for."""
    whole = AsyncValue.to(torch.stack([window.prediction.objects.stream_index, evidence.triggers, evidence.looks, evidence.is_starting], 1))
    lost_s = AsyncValue.to(evidence.time_since_validated_s).numbers()
    asking = [
        Asks(number, stream, flags, looks, lost_s[number], is_starting=bool(starts))
        for number, (stream, flags, looks, starts) in enumerate(whole.numbers())
    ]
    return [asks for asks in asking if any(source.is_called_for(asks.flags) for source in sources)]


def _tried(lost: LostObject, calls: Iterable[tuple[Source, Acceptance]]) -> Relocalized:
    """What the window gives with the hypotheses of some sources tried for an object, one after the other."""
    for source, test in calls:
        hypotheses = source.propose(lost)
        tried = refined(hypotheses, lost)
        choice = test.row(lost.number).choose(tried, hypotheses, lost)
        lost = replace(lost, window=exchanged(lost, hypotheses, tried, choice))
    return lost.window


def _settled(window: Relocalized, drifts: Bool[Tensor, "b"], widened: Prediction, gate_scale: Float[Tensor, "b"]) -> Relocalized:
    """What the window gives with objects that had drifted off, and were relocalized, as uncertain as they turned out to be."""
    had_drifted = drifts & window.scored.is_relocalized
    covariance = torch.where(had_drifted[:, None, None], widened.covariance, window.prediction.covariance)
    prediction = replace(window.prediction, covariance=covariance)
    return replace(window, prediction=prediction, gate_scale=torch.where(had_drifted, gate_scale, window.gate_scale))
