"""Many poses tried at once, where one prediction is too uncertain: after an occlusion, or when a pose begins to slip.

The most promising of thousands (:mod:`torchtrack.tracking.relocalization.hypotheses`) are aligned as one batch; the one that explains most is taken.
"""

from dataclasses import fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import Fit, align, index_for
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.acceptance import is_likely, less_where_lines_run_on, likeliest, scored_by_events
from torchtrack.tracking.relocalization.hypotheses import promising
from torchtrack.tracking.relocalization.last_seen import less_certain
from torchtrack.tracking.validation.scored_fit import Found, judge_fit

# So many of the poses of a very uncertain object, those that explain most, are aligned again.
_ALIGNED_AGAIN = 8


def search(
    number: int, prediction: Prediction, sigma_px: float, least: Float[Tensor, "4"], events: ObjectEvents, found: Found, config: TrackerConfig
) -> Found:
    """Try other poses for the object ``number``; ``found`` with the best of them in its place, if that is better.

    Args:
        sigma_px: standard deviation of the object's prediction in the image.
        least: by how much another pose must explain more, how much it must explain, how much of the events around it it must gather, and
            how many events it must explain.
        events: of all objects.
    """
    return search_around(number, prediction.copies(number, 1), found.fit.contours.of(number), sigma_px, least, events, found, config)


def search_around(
    number: int,
    one: Prediction,
    outline: Contours,
    sigma_px: float,
    least: Float[Tensor, "4"],
    events: ObjectEvents,
    found: Found,
    config: TrackerConfig,
) -> Found:
    """:func:`search` around the prediction of one object alone, with its contours there."""
    widened_px = max(sigma_px, config.search.least_sigma_px)
    covariance, seen = less_certain(one, 0, sigma_px, widened_px).covariance[0], events.of(number)
    places = one.carried(seen.pixels, seen.age_s), seen.mask
    offsets = promising(one, outline, covariance, widened_px, places, config)
    on, wide = (seen, config, found.full_gathered[number], found.asked_apart[number]), sigma_px > config.search.wide_sigma_px
    tried = align_all(one.copies(0, len(offsets)), offsets, *on)
    for _ in range(config.search.realigned if wide else 0):
        # From some way off, a pose comes near the right one before its contours are those that are seen there.
        best = tried.score.topk(min(_ALIGNED_AGAIN, len(tried.score))).indices
        tried = align_all(one.copies(0, len(best)), tried.fit.solution.from_prior[best], *on)
    offset = tried.fit.solution.from_prior
    margin, needed, gathered, count = least.unbind()
    # Written so that what does not tell how far it gathers counts.
    counts = (tried.count >= count.clamp(min=config.quality.min_observations)) & is_likely(offset, covariance) & ~(tried.gathered < gathered)
    score = torch.where(counts, tried.score, 0)
    mine = torch.where(found.count[number] >= config.quality.min_observations, found.score[number], 0.0)
    asked = torch.maximum(mine + margin, needed)
    if config.search.line_ends and wide:
        score = less_where_lines_run_on(score, score > asked, tried.fit.contours, places, one.objects.image_size)
    by_events = config.search.by_events and wide
    best = likeliest(scored_by_events(score, tried.count) if by_events else score, offset, one.covariance[0])
    better = score.index_select(0, best) > asked
    return found if host_sync.none_of(better) else replaced(found, number, tried, best, better)


def rehearse(prediction: Prediction, config: TrackerConfig) -> None:
    """Call what a wide search of one object calls beside what any window does: kernels are compiled, or read from the disk, at that."""
    one = prediction.copies(0, 1)
    outline, nowhere = one.objects.contours(one.T_cam_obj, config.contours), one.T_cam_obj.new_zeros(1, 1, 2)
    promising(one, outline, one.covariance[0], 2 * config.search.wide_sigma_px, (nowhere, torch.zeros(1, 1, dtype=torch.bool)), config)


def align_all(
    copies: Prediction, offsets: Tensor, seen: WindowEvents, config: TrackerConfig, full_gathered: Float[Tensor, ""], asked_apart: Float[Tensor, ""]
) -> Found:
    """Align copies of one object, each from its own offset, on the events of the object."""
    begin = copies.moved(offsets)
    contours = copies.objects.contours(begin.T_cam_obj, config.contours)
    tight = torch.ones_like(offsets[:, 0])
    index = index_for(contours, copies.objects.image_size, config, tight)
    events = seen.repeated(len(offsets))
    observations = select_events(events, index, begin.moving(compensated=True), config.matching.max_events)
    fit = align(copies, contours, index, tight, observations, config, offsets)
    found = judge_fit(copies, fit, config, torch.zeros_like(tight), full_gathered.expand_as(tight), asked_apart.expand_as(tight))
    return replace(found, elsewhere=torch.ones_like(found.elsewhere))


def replaced(found: Found, number: int, other: Found, row: Int[Tensor, "1"], better: Bool[Tensor, "1"]) -> Found:
    """``found`` with one object's poses, contours and quality from a row of another, where that is better."""

    def put(mine: Tensor, theirs: Tensor) -> Tensor:
        value = mine.clone()
        value[number] = torch.where(better.view([1] * mine.dim()), theirs.index_select(0, row), mine[number : number + 1])[0]
        return value

    mine, theirs = found.fit, other.fit
    solution = Linearisation(*(put(value, getattr(theirs.solution, name)) for name, value in vars(mine.solution).items()))
    count = max(mine.contours.mask.shape[1], theirs.contours.mask.shape[1])
    own, others = mine.contours.widened(count), theirs.contours.widened(count)
    contours = Contours(*(put(value, getattr(others, name)) for name, value in vars(own).items()))
    names = [field.name for field in fields(Found) if field.name not in ("fit", "turn_unclear")]
    told = {name: put(getattr(found, name), getattr(other, name)) for name in names}
    # Another pose says nothing of whether it is the only one.
    return Found(fit=Fit(solution, contours, mine.matches), turn_unclear=found.turn_unclear, **told)
