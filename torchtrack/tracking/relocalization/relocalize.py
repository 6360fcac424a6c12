"""Which other poses are tried for which objects, and what is asked of each: beside the prediction, where they slipped to, and so on."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.host_sync import AsyncValue
from torchtrack.tracking.estimation.rounds import gate_widening
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.acceptance import AS_MUCH, is_taken
from torchtrack.tracking.relocalization.axis_rotation import TurningAxes, turns_compared
from torchtrack.tracking.relocalization.last_seen import LastSeen, as_last_seen, drifted, less_certain
from torchtrack.tracking.relocalization.refine import search, search_around
from torchtrack.tracking.relocalization.symmetric import SymmetryPlanes, mirrored
from torchtrack.tracking.relocalization.triggers import Doubt
from torchtrack.tracking.validation.scored_fit import Found
from torchtrack.tracking.validation.status import are_many

# What explains so many times as many events as a pose far off in depth is no smaller thing that chance explains.
_FAR_MORE = 2.0


def search_wanted(
    prediction: Prediction,
    doubt: Doubt,
    events: ObjectEvents,
    found: Found,
    widening: Float[Tensor, "b"],
    config: TrackerConfig,
    last_seen: LastSeen,
    planes: SymmetryPlanes,
    axes: TurningAxes,
) -> tuple[Found, Prediction, Float[Tensor, "b"]]:
    """Try other poses for the objects that need it, one object after the other: beside the prediction, where it may have slipped to, and so on.

    Args:
        last_seen: where the objects were seen well for the last time.
        planes: of symmetry.
        axes: that most of an object can be turned about unseen.

    Returns:
        What was found, the prediction that it is to be weighed against, and the widening of the first gates: of an object that had
        drifted off, those of one as uncertain as it turned out to be.
    """
    # Without events no pose is better than another.
    enough = events.counts() >= config.quality.min_observations
    stands = _stands(doubt, found, config)
    reasons = (stands, *doubt.reasons(found.score, config.search), doubt.has_run_off(config.search))
    least_near, least_far, least_anew, least_last_seen = _least(doubt, found, config)
    doubt = replace(doubt, adrift=doubt.adrift & ~stands)
    uncertain = drifted(prediction, doubt, config.search)
    sigma_px = torch.where(doubt.adrift, uncertain.sigma_px(found.fit.contours), doubt.sigma_px)
    answers = (AsyncValue.to(values).numbers() for values in (*(enough & reason for reason in reasons), sigma_px, doubt.sigma_px))
    for number, told in enumerate(zip(*answers, strict=True)):
        it_stands, is_tried, may_have_slipped, is_mirrored, is_turned, has_run_off, own_sigma_px, predicted_px = told
        if it_stands:
            found = _search_slipped(number, uncertain, own_sigma_px, least_near[:, number], events, found, config)
        elif is_tried:
            found = search(number, uncertain, own_sigma_px, least_near[:, number], events, found, config)
        if may_have_slipped:
            found = _search_slipped(number, uncertain, own_sigma_px, least_far[:, number], events, found, config)
        if has_run_off:
            other = as_last_seen(uncertain.copies(number, 1), last_seen.T_cam_obj[number])
            found, prediction = _search_from(number, other, own_sigma_px, least_last_seen[:, number], events, found, prediction, config)
        for plane in planes.of(number) if is_mirrored else ():
            other = less_certain(mirrored(_as_found(number, prediction, found), *plane), 0, predicted_px, config.search.slip_sigma_px)
            found, prediction = _search_from(number, other, config.search.slip_sigma_px, least_far[:, number], events, found, prediction, config)
        if is_turned:
            one, unseen_s = _as_found(number, prediction, found), doubt.unseen_s[number]
            found, prediction = turns_compared(number, one, axes, unseen_s, events, found, prediction, config)
    was_adrift = doubt.adrift & found.elsewhere
    prediction = replace(prediction, covariance=torch.where(was_adrift[:, None, None], uncertain.covariance, prediction.covariance))
    widening = torch.where(was_adrift, gate_widening(sigma_px, config), widening)
    return _search_anew(doubt, last_seen, least_anew, events, (found, prediction, widening), config)


def _search_anew(
    doubt: Doubt,
    last_seen: LastSeen,
    least: Float[Tensor, "4 b"],
    events: ObjectEvents,
    so_far: tuple[Found, Prediction, Float[Tensor, "b"]],
    config: TrackerConfig,
) -> tuple[Found, Prediction, Float[Tensor, "b"]]:
    """:func:`search_wanted` for objects that are far off in depth, or explain little: around where they were last seen well."""
    found, prediction, widening = so_far
    anywhere = gate_widening(torch.full_like(widening, torch.inf), config)
    for number, is_sought in enumerate(AsyncValue.to(doubt.anew()).numbers()):
        if is_sought:
            # A look from there is a wide one, however far this one goes.
            other, wide_px, before = last_seen.prediction(number, prediction), 2 * config.search.wide_sigma_px, found
            found, prediction = _search_from(number, other, wide_px, least[:, number], events, found, prediction, config)
            own = torch.arange(len(widening), device=widening.device) == number
            widening = torch.where(own & is_taken(number, found, before), anywhere, widening)
    return found, prediction, widening


def _stands(doubt: Doubt, found: Found, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects, long in doubt and yet sure of their place, explain enough there: they are looked for as if they had slipped, not far away.

    Where something passes before an object, its edges smear the events around it, and what is laid along them explains more.
    """
    sure = doubt.adrift & ~doubt.strayed & ~doubt.starting & (doubt.sigma_px < config.search.slip_sigma_px)
    explains = found.score >= config.search.stands_from * doubt.full_share
    return sure & explains & are_many(found.count, config.quality) & (config.search.stands_from > 0)


def _least(doubt: Doubt, found: Found, config: TrackerConfig) -> Float[Tensor, "4 4 b"]:
    """By how much other poses must explain more, how much they must explain and gather, and by how many events at least.

    And the same of where an object is not predicted at all, of where it was last seen well, if it is far off in depth or explains little,
    and if it is in doubt.

    While a motion is not known nothing says how far events gather when all is well, and dense print explains as much of many poses:
    one that smears the events more than the prediction's own is not better.
    """
    search, none = config.search, torch.zeros_like(doubt.full_share)
    margin = torch.where(doubt.starting, search.start_margin, search.margin)
    # What is far away has to explain about as much as usual; so has what is found step by step, while a motion is lost, ever farther away.
    needed = torch.where(doubt.adrift | doubt.starting, search.adrift_share * doubt.full_share, 0)
    # What is partly hidden explains less, too: nothing but the whole object, seen elsewhere by no fewer events, speaks against that.
    # A part of its edges does not.
    margin = torch.where(doubt.strayed, search.slip_margin, margin)
    needed = torch.where(doubt.strayed, search.slip_share * doubt.full_share, needed)
    matched = found.count.to(margin.dtype)
    count = torch.where(doubt.strayed, matched, 0)
    # Of a new object, only what explains nearly all is surely better: edges of what hides it explain half.
    new = doubt.is_new(found.score, search)
    needed = torch.where(new, search.new_share, needed)
    gathered = torch.where(doubt.starting | new, found.gathered.nan_to_num(0.0) - AS_MUCH, 0)
    elsewhere = none + search.slip_margin, search.slip_share * doubt.full_share, none, none
    # A small thing that is all explained says nothing against one of which far more events are explained. What is partly hidden does.
    off = doubt.off_in_depth
    needed_anew = torch.where(off, config.quality.certain_at, search.slip_share) * doubt.full_share
    anew = torch.where(off, -torch.inf, search.slip_margin), needed_anew, none, torch.where(off, _FAR_MORE, 1) * matched
    last_seen = *elsewhere[:3], torch.where(_stands(doubt, found, config), _FAR_MORE * matched, count)
    return torch.stack([margin, needed, gathered, count, *elsewhere, *anew, *last_seen]).unflatten(0, (4, 4))


def _search_slipped(
    number: int, prediction: Prediction, sigma_px: float, least: Float[Tensor, "4"], events: ObjectEvents, found: Found, config: TrackerConfig
) -> Found:
    """:func:`search` for an object that is sure of where it is, and may be farther off than that.

    Held by its prediction, no pose some pixels away is found, however much it explains. What is found goes on as certain as
    if it had been predicted: who is not held at all wanders off from one find to the next.
    """
    slip_px = config.search.slip_sigma_px
    other = search(number, less_certain(prediction, number, sigma_px, slip_px), slip_px, least, events, found, config)
    if other is found:
        return found
    solution = other.fit.solution
    let_go = config.solver.observation_px**2 * (1 - (sigma_px / slip_px) ** 2) * prediction.information[number]
    hessian = solution.hessian.clone()
    hessian[number, :12, :12] += (let_go * is_taken(number, other, found)).to(hessian.dtype)
    return replace(other, fit=replace(other.fit, solution=replace(solution, hessian=hessian)))


def _as_found(number: int, prediction: Prediction, found: Found) -> Prediction:
    """The prediction of one object alone, moved to where it was found."""
    solution = found.fit.solution
    return prediction.copies(number, 1).at(solution.T_cam_obj[number : number + 1], solution.from_prior[number : number + 1])


def _search_from(
    number: int,
    other: Prediction,
    sigma_px: float,
    least: Float[Tensor, "4"],
    events: ObjectEvents,
    found: Found,
    prediction: Prediction,
    config: TrackerConfig,
) -> tuple[Found, Prediction]:
    """:func:`search` around another prediction of the object, which takes the place of its own if it is found there."""
    outline = other.objects.contours(other.T_cam_obj, config.contours)
    better = search_around(number, other, outline, sigma_px, least, events, found, config)
    return (found, prediction) if better is found else (better, prediction.exchanged(number, other, is_taken(number, better, found)))
