"""Hypotheses aligned and scored as a batch, and what is exchanged where one of them is accepted."""

from dataclasses import fields, replace

import torch
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import Fit, Start, align, index_for
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.relocalization.acceptance import Choice
from torchtrack.tracking.relocalization.hypotheses import Hypotheses
from torchtrack.tracking.relocalization.lost_object import LostObject, Relocalized
from torchtrack.tracking.validation.scored_fit import ScoredFit, score_fit


def refined(hypotheses: Hypotheses, lost: LostObject) -> ScoredFit:
    """The hypotheses aligned on the events of their object, and scored."""
    config, scored, number, offsets = lost.config, lost.window.scored, lost.number, hypotheses.offsets
    rows = hypotheses.prediction.copies(0, len(offsets))
    begin = rows.moved(offsets)
    contours = rows.objects.contours(begin.T_cam_obj, config.contours)
    tight = torch.ones_like(offsets[:, 0])
    index = index_for(contours, rows.objects.image_size, config, tight)
    events = lost.events.repeated(len(offsets))
    observations = select_events(events, index, begin.moving(compensated=True), config.association.max_events)
    fit = align(Start(rows, contours, index, tight, offsets), observations, config)
    references = (value[number].expand_as(tight) for value in (scored.reference_inlier_ratio, scored.required_spread))
    tried = score_fit(rows, fit, config, torch.zeros_like(tight), *references)
    return replace(tried, is_relocalized=torch.ones_like(tried.is_relocalized))


def exchanged(lost: LostObject, hypotheses: Hypotheses, tried: ScoredFit, choice: Choice) -> Relocalized:
    """What the window gave, with the chosen hypothesis in the place of the object's own pose, where that is accepted."""
    window, number, accepted = lost.window, lost.number, choice.is_accepted
    if host_sync.none_of(accepted):
        return window
    scored, prediction, gate_scale = replaced(window.scored, number, tried, choice), window.prediction, window.gate_scale
    if hypotheses.replaces_prediction:
        prediction = prediction.exchanged(number, hypotheses.prediction, accepted[0])
    if hypotheses.gate_scale is not None:
        own = torch.arange(len(gate_scale), device=gate_scale.device) == number
        gate_scale = torch.where(own & accepted, hypotheses.gate_scale, gate_scale)
    return replace(window, scored=scored, prediction=prediction, gate_scale=gate_scale)


def replaced(scored: ScoredFit, number: int, tried: ScoredFit, choice: Choice) -> ScoredFit:
    """``scored`` with the pose, contours and quality of an object from the chosen row of what was tried, where that is accepted."""

    def put(mine: Tensor, theirs: Tensor) -> Tensor:
        value = mine.clone()
        accepted = choice.is_accepted.view([1] * mine.dim())
        value[number] = torch.where(accepted, theirs.index_select(0, choice.row), mine[number : number + 1])[0]
        return value

    mine, theirs = scored.fit, tried.fit
    solution = Linearisation(*(put(value, getattr(theirs.solution, name)) for name, value in vars(mine.solution).items()))
    count = max(mine.contours.mask.shape[1], theirs.contours.mask.shape[1])
    own, others = mine.contours.widened(count), theirs.contours.widened(count)
    contours = Contours(*(put(value, getattr(others, name)) for name, value in vars(own).items()))
    names = [field.name for field in fields(ScoredFit) if field.name != "fit"]
    measures = {name: put(getattr(scored, name), getattr(tried, name)) for name in names}
    return ScoredFit(fit=Fit(solution, contours, mine.matches), **measures)
