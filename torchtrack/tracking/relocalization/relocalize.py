"""The loop of relocalization: of each source in turn, the objects that a trigger calls it for, as compact batches; propose, refine, accept."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.host_sync import AsyncValue
from torchtrack.tracking.estimation.rounds import gate_scale_of
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.acceptance import Acceptance
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.last_seen import LastSeen, with_drift
from torchtrack.tracking.relocalization.looks import Asks, among, in_turn
from torchtrack.tracking.relocalization.lost_objects import LostObjects, Relocalized
from torchtrack.tracking.relocalization.refine import exchanged, refined
from torchtrack.tracking.relocalization.sources import SOURCES, Source
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, DRIFTS, Trigger, has

# Objects that are tried together: what they need stays in a processor's nearer memory. On a GPU, it is what is asked for that takes time; of so
# many, hypotheses need a gigabyte or two.
_TOGETHER, _TOGETHER_ON_GPU = 1, 8


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
    is_wide = AsyncValue.to(sigma_px > config.relocalization.wide_sigma_px).numbers()
    for comes_last in (False, True):
        for source, test in zip(sources, tests, strict=True):
            called = [asks.number for asks in looks if source.comes_last == comes_last and source.is_called_for(asks.flags)]
            groups = [[number for number in called if is_wide[number] == wide] for wide in (False, True)] if source.in_two_ways else [called]
            for numbers in _batches(groups, _TOGETHER_ON_GPU if host_sync.on_gpu(sigma_px) else _TOGETHER):
                rows = constant(numbers, torch.int64, sigma_px.device)
                of_them = sigma_px[rows], is_wide[numbers[0]], events.of_objects(rows)
                window = _tried(LostObjects(numbers, window, widened, *of_them, last_seen, config), source, test)
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


def _batches(groups: Iterable[Sequence[int]], together: int) -> Iterator[tuple[int, ...]]:
    """The numbers of each group, no more than so many ``together``."""
    for numbers in groups:
        yield from (tuple(numbers[begin : begin + together]) for begin in range(0, len(numbers), together))


def _tried(lost: LostObjects, source: Source, test: Acceptance) -> Relocalized:
    """What the window gives with the hypotheses of a source tried for some objects."""
    hypotheses = source.propose(lost)
    tried = refined(hypotheses, lost)
    return exchanged(lost, hypotheses, tried, test.rows(lost.rows).choose(tried, hypotheses, lost))


def _settled(window: Relocalized, drifts: Bool[Tensor, "b"], widened: Prediction, gate_scale: Float[Tensor, "b"]) -> Relocalized:
    """What the window gives with objects that had drifted off, and were relocalized, as uncertain as they turned out to be."""
    had_drifted = drifts & window.scored.is_relocalized
    covariance = torch.where(had_drifted[:, None, None], widened.covariance, window.prediction.covariance)
    prediction = replace(window.prediction, covariance=covariance)
    return replace(window, prediction=prediction, gate_scale=torch.where(had_drifted, gate_scale, window.gate_scale))
