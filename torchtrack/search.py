"""Many poses tried at once, where one prediction is too uncertain: after an occlusion, or when a pose begins to slip.

The most promising of thousands (:mod:`torchtrack.hypotheses`) are aligned as one batch; the one that explains most is taken.
"""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack import quality, readback
from torchtrack.alignment import Fit, align, gate_widening, index_for
from torchtrack.config.tracker import SearchConfig, TrackerConfig
from torchtrack.contours import Contours
from torchtrack.doubt import Doubt, drifted, less_certain
from torchtrack.hypotheses import promising
from torchtrack.observations import ObjectEvents, WindowEvents, select_events
from torchtrack.once import once
from torchtrack.other_places import SymmetryPlanes, as_last_seen, mirrored
from torchtrack.pose_problem import Linearisation
from torchtrack.prediction import Prediction
from torchtrack.readback import Answer

# Shares that differ by less are the same: which of them is larger is chance.
_AS_MUCH = 0.02
# The 99th percentile of the squared distance of a pose, of six dimensions, in standard deviations (chi-square).
_LIKELY = 16.8
# A pose explains no fewer events than another where it explains this share of theirs.
_AS_MANY = 0.8
# From this share of how far they do when an object is seen well, events gather in full.
_AS_GATHERED = 0.9


@dataclass(frozen=True)
class Found:
    """What one window gave for each object.

    Args:
        fit: poses, and what they stand on.
        measured: share of the moving contour that events explain; not a number where hardly anything moves.
        at_rest: what stands for it then.
        count: matched observations.
        gathered: share of the events near the contour that are on it; not a number where it does not tell.
        full_gathered: the same of when the object is seen well.
        elsewhere: which objects a search found in another place than the prediction led to.
    """

    fit: Fit
    measured: Float[Tensor, "b"]
    at_rest: Float[Tensor, "b"]
    count: Int[Tensor, "b"]
    gathered: Float[Tensor, "b"]
    full_gathered: Float[Tensor, "b"]
    elsewhere: Bool[Tensor, "b"]

    @once
    def share(self) -> Float[Tensor, "b"]:
        """What events explain of the contour."""
        return torch.where(self.measured.isnan(), self.at_rest, self.measured)

    @once
    def score(self) -> Float[Tensor, "b"]:
        """The share, and less where the events around the contour are smeared: what poses are compared by."""
        gathered = self.gathered / (_AS_GATHERED * self.full_gathered).clamp(min=1e-3)
        return self.share * gathered.nan_to_num(1.0).clamp(max=1)


def judge_fit(
    prediction: Prediction, fit: Fit, config: TrackerConfig, at_rest: Float[Tensor, "b"], full_gathered: Float[Tensor, "b"] | None = None
) -> Found:
    """A fit with its quality, by the motion that was found with it; without enough observations it explains nothing.

    Args:
        full_gathered: of when each object is seen well; zero, or none at all, where that is not known.
    """
    moving = prediction.at(fit.solution.T_cam_obj, fit.solution.from_prior).moving(compensated=True)
    measured, gathered = quality.shares(fit.contours, fit.matches, moving, prediction.objects.image_size, config.quality)
    # Of what does not move, events are noise.
    gathered = torch.where(measured.isnan(), torch.nan, gathered) if config.search.by_gathering else torch.full_like(measured, torch.nan)
    full_gathered = torch.zeros_like(measured) if full_gathered is None else full_gathered
    return Found(fit, measured, at_rest, fit.matches.mask.sum(-1), gathered, full_gathered, torch.zeros_like(measured, dtype=torch.bool))


def explained_at_rest(widening: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """What an object explains that does not move: all, but nothing where it was looked for in many places.

    Args:
        widening: of each object's first gate.
    """
    return 2 - widening.clamp(1, 2)


def search_wanted(
    prediction: Prediction,
    doubt: Doubt,
    events: ObjectEvents,
    found: Found,
    widening: Float[Tensor, "b"],
    config: TrackerConfig,
    T_last_seen: Float[Tensor, "b 4 4"],
    planes: SymmetryPlanes,
) -> tuple[Found, Prediction, Float[Tensor, "b"]]:
    """Try other poses for the objects that need it, one object after the other: beside the prediction, where it may have slipped to, and so on.

    Args:
        T_last_seen: poses of the objects when they were last seen well.
        planes: of symmetry.

    Returns:
        What was found, the prediction that it is to be weighed against, and the widening of the first gates: of an object that had
        drifted off, those of one as uncertain as it turned out to be.
    """
    # Without events no pose is better than another.
    enough = events.counts() >= config.quality.min_observations
    reasons = (*doubt.reasons(found.score, config.search), doubt.has_run_off(config.search))
    least_near, least_far = _least(doubt, found, config.search)
    uncertain = drifted(prediction, doubt, config.search)
    sigma_px = torch.where(doubt.adrift, uncertain.sigma_px(found.fit.contours), doubt.sigma_px)
    answers = (Answer.to(values).numbers() for values in (*(enough & reason for reason in reasons), sigma_px, doubt.sigma_px))
    for number, (is_tried, may_have_slipped, is_mirrored, has_run_off, own_sigma_px, predicted_px) in enumerate(zip(*answers, strict=True)):
        if is_tried:
            found = search(number, uncertain, own_sigma_px, least_near[:, number], events, found, config)
        if may_have_slipped:
            found = _search_slipped(number, uncertain, own_sigma_px, least_far[:, number], events, found, config)
        if has_run_off:
            other = as_last_seen(uncertain.copies(number, 1), T_last_seen[number])
            found, prediction = _search_from(number, other, own_sigma_px, least_far[:, number], events, found, prediction, config)
        for plane in planes.of(number) if is_mirrored else ():
            other = less_certain(mirrored(_as_found(number, prediction, found), *plane), 0, predicted_px, config.search.slip_sigma_px)
            found, prediction = _search_from(number, other, config.search.slip_sigma_px, least_far[:, number], events, found, prediction, config)
    was_adrift = doubt.adrift & found.elsewhere
    prediction = replace(prediction, covariance=torch.where(was_adrift[:, None, None], uncertain.covariance, prediction.covariance))
    return found, prediction, torch.where(was_adrift, gate_widening(sigma_px, config), widening)


def _least(doubt: Doubt, found: Found, config: SearchConfig) -> Float[Tensor, "2 4 b"]:
    """By how much other poses must explain more, how much they must explain and gather, and by how many events at least.

    And the same of where an object is not predicted at all.

    While a motion is not known nothing says how far events gather when all is well, and dense print explains as much of many poses:
    one that smears the events more than the prediction's own is not better.
    """
    margin = torch.where(doubt.starting, config.start_margin, config.margin)
    # What is far away has to explain about as much as usual; so has what is found step by step, while a motion is lost, ever farther away.
    needed = torch.where(doubt.adrift | doubt.starting, config.adrift_share * doubt.full_share, 0)
    # What is partly hidden explains less, too: nothing but the whole object, seen elsewhere, speaks against that. A part of its edges does not.
    margin = torch.where(doubt.strayed, config.slip_margin, margin)
    needed = torch.where(doubt.strayed, config.slip_share * doubt.full_share, needed)
    count = torch.where(doubt.strayed, _AS_MANY * found.count.to(margin.dtype), 0)
    # Of a new object, only what explains nearly all is surely better: edges of what hides it explain half.
    new = doubt.is_new(found.score, config)
    needed = torch.where(new, config.new_share, needed)
    gathered = torch.where(doubt.starting | new, found.gathered.nan_to_num(0.0) - _AS_MUCH, 0)
    elsewhere = torch.full_like(margin, config.slip_margin), config.slip_share * doubt.full_share, torch.zeros_like(margin), torch.zeros_like(count)
    return torch.stack([margin, needed, gathered, count, *elsewhere]).unflatten(0, (2, 4))


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
    hessian[number, :12, :12] += (let_go * _is_taken(number, other, found)).to(hessian.dtype)
    return replace(other, fit=replace(other.fit, solution=replace(solution, hessian=hessian)))


def _is_taken(number: int, other: Found, found: Found) -> Bool[Tensor, ""]:
    """Whether a search found the object ``number`` in another pose; a GPU is not waited for to know."""
    return (other.fit.solution.T_cam_obj[number] != found.fit.solution.T_cam_obj[number]).any()


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
    better = _search_around(number, other, outline, sigma_px, least, events, found, config)
    return (found, prediction) if better is found else (better, prediction.exchanged(number, other, _is_taken(number, better, found)))


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
    return _search_around(number, prediction.copies(number, 1), found.fit.contours.of(number), sigma_px, least, events, found, config)


def _search_around(
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
    tried = _align_all(one.copies(0, len(offsets)), offsets, seen, config, found.full_gathered[number])
    offset = tried.fit.solution.from_prior
    margin, needed, gathered, count = least.unbind()
    # Written so that what does not tell how far it gathers counts.
    counts = (tried.count >= count.clamp(min=config.quality.min_observations)) & _is_likely(offset, covariance) & ~(tried.gathered < gathered)
    score = torch.where(counts, tried.score, 0)
    best = _likeliest(score, offset, one.covariance[0])
    mine = torch.where(found.count[number] >= config.quality.min_observations, found.score[number], 0.0)
    better = score.index_select(0, best) > torch.maximum(mine + margin, needed)
    return found if readback.none_of(better) else _replaced(found, number, tried, best, better)


def rehearse(prediction: Prediction, config: TrackerConfig) -> None:
    """Call what a wide search of one object calls beside what any window does: kernels are compiled, or read from the disk, at that."""
    one = prediction.copies(0, 1)
    outline, nowhere = one.objects.contours(one.T_cam_obj, config.contours), one.T_cam_obj.new_zeros(1, 1, 2)
    promising(one, outline, one.covariance[0], 2 * config.search.wide_sigma_px, (nowhere, torch.zeros(1, 1, dtype=torch.bool)), config)


def _is_likely(from_prior: Float[Tensor, "n k"], covariance: Float[Tensor, "12 12"]) -> Bool[Tensor, "n"]:
    """Which poses lie where all but one in a hundred of a covariance do: edges of what hides an object explain much of it, farther away."""
    return _squared_deviations(from_prior[:, :6], covariance[:6, :6]) < _LIKELY


def _squared_deviations(offsets: Float[Tensor, "n k"], covariance: Float[Tensor, "k k"]) -> Float[Tensor, "n"]:
    """Squared distance of offsets in standard deviations (Mahalanobis)."""
    root = torch.linalg.cholesky_ex(covariance).L
    return torch.linalg.solve_triangular(root, offsets.to(root.dtype).T, upper=False).square().sum(0)


def _likeliest(score: Float[Tensor, "n"], from_prior: Float[Tensor, "n k"], covariance: Float[Tensor, "12 12"]) -> Int[Tensor, "1"]:
    """Of the poses that explain as much as the best does, the one that the prediction expects most: a turn of a vase explains nothing."""
    away = _squared_deviations(from_prior[:, :12], covariance)
    return torch.where(score >= score.max() - _AS_MUCH, away.nan_to_num(torch.inf), torch.inf).argmin()[None]


def _align_all(copies: Prediction, offsets: Tensor, seen: WindowEvents, config: TrackerConfig, full_gathered: Float[Tensor, ""]) -> Found:
    """Align copies of one object, each from its own offset, on the events of the object."""
    begin = copies.moved(offsets)
    contours = copies.objects.contours(begin.T_cam_obj, config.contours)
    tight = torch.ones_like(offsets[:, 0])
    index = index_for(contours, copies.objects.image_size, config, tight)
    events = seen.repeated(len(offsets))
    observations = select_events(events, index, begin.moving(compensated=True), config.matching.max_events)
    fit = align(copies, contours, index, tight, observations, config, offsets)
    found = judge_fit(copies, fit, config, torch.zeros_like(tight), full_gathered.expand_as(tight))
    return replace(found, elsewhere=torch.ones_like(found.elsewhere))


def _replaced(found: Found, number: int, other: Found, row: Int[Tensor, "1"], better: Bool[Tensor, "1"]) -> Found:
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
    names = [field.name for field in fields(Found) if field.name != "fit"]
    return Found(Fit(solution, contours, mine.matches), *(put(getattr(found, name), getattr(other, name)) for name in names))
