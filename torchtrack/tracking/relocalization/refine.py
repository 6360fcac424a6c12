"""Hypotheses aligned and scored as a batch, and what is exchanged where one of them is accepted."""

from dataclasses import fields, replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.padded import put_rows, repeated
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import Fit, Start, align, index_for
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.relocalization.acceptance import Choice
from torchtrack.tracking.relocalization.hypotheses import Hypotheses
from torchtrack.tracking.relocalization.lost_objects import LostObjects, Relocalized
from torchtrack.tracking.validation.scored_fit import ScoredFit, score_fit


def refined(hypotheses: Hypotheses, lost: LostObjects) -> ScoredFit:
    """The hypotheses aligned on the events of their objects, and scored."""
    config, scored, offsets, objects = lost.config, lost.window.scored, hypotheses.offsets, range(len(lost.numbers))
    rows = hypotheses.prediction.copies(objects, len(offsets) // len(objects))
    begin = rows.moved(offsets)
    contours = rows.objects.contours(begin.T_cam_obj, config.contours)
    tight = torch.ones_like(offsets[:, 0])
    index = index_for(contours, rows.objects.image_size, config, tight)
    events = lost.events.repeated(len(offsets))
    observations = select_events(events, index, begin.moving(compensated=True), config.association.max_events)
    fit = align(Start(rows, contours, index, tight, offsets), observations, config)
    references = (repeated(value[lost.rows], len(offsets)) for value in (scored.reference_inlier_ratio, scored.required_spread))
    tried = score_fit(rows, fit, config, torch.zeros_like(tight), *references)
    return replace(tried, is_relocalized=torch.ones_like(tried.is_relocalized))


def exchanged(lost: LostObjects, hypotheses: Hypotheses, tried: ScoredFit, choice: Choice) -> Relocalized:
    """What the window gave, with the chosen hypotheses in the place of the objects' own poses, where they are accepted."""
    window, accepted = lost.window, choice.is_accepted
    if host_sync.none_of(accepted):
        return window
    scored, prediction, gate_scale = replaced(window.scored, lost.rows, tried, choice), window.prediction, window.gate_scale
    if hypotheses.replaces_prediction:
        prediction = prediction.exchanged(lost.rows, hypotheses.prediction, accepted)
    if hypotheses.gate_scale is not None:
        gate_scale = put_rows(gate_scale, lost.rows, hypotheses.gate_scale, accepted)
    return replace(window, scored=scored, prediction=prediction, gate_scale=gate_scale)


def replaced(scored: ScoredFit, rows: Int[Tensor, "k"], tried: ScoredFit, choice: Choice) -> ScoredFit:
    """``scored`` with the pose, contours and quality of some objects from the chosen rows of what was tried, where these are accepted."""

    def put(mine: Tensor, theirs: Tensor) -> Tensor:
        return put_rows(mine, rows, theirs.index_select(0, choice.row), choice.is_accepted)

    mine, theirs = scored.fit, tried.fit
    solution = Linearisation(*(put(value, getattr(theirs.solution, name)) for name, value in vars(mine.solution).items()))
    count = max(mine.contours.mask.shape[1], theirs.contours.mask.shape[1])
    own, others = mine.contours.widened(count), theirs.contours.widened(count)
    contours = Contours(*(put(value, getattr(others, name)) for name, value in vars(own).items()))
    names = [field.name for field in fields(ScoredFit) if field.name != "fit"]
    measures = {name: put(getattr(scored, name), getattr(tried, name)) for name in names}
    return ScoredFit(fit=Fit(solution, contours, mine.matches), **measures)
