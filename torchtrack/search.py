"""Many poses tried at once, where one prediction is too uncertain: after an occlusion, or when a pose begins to slip.

The most promising of thousands (:mod:`torchtrack.hypotheses`) are aligned as one batch; the one that explains most is taken.
"""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack import quality
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.constants import once
from torchtrack.doubt import less_certain
from torchtrack.hypotheses import promising
from torchtrack.line_ends import running_on
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import Fit, align, index_for
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction

# Shares that differ by less are the same: which of them is larger is chance.
AS_MUCH = 0.02
# The 99th percentile of the squared distance of a pose, of six dimensions, in standard deviations (chi-square).
_LIKELY = 16.8
# So many of the poses of a very uncertain object, those that explain most, are aligned again.
_ALIGNED_AGAIN = 8
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
        apart: how far apart the directions of the contours are that events lie on.
        asked_apart: how far apart they have to be to count in full; zero for nothing asked.
        elsewhere: which objects a search found in another place than the prediction led to.
        turn_unclear: which may be turned otherwise about their axis (:mod:`torchtrack.turns`).
    """

    fit: Fit
    measured: Float[Tensor, "b"]
    at_rest: Float[Tensor, "b"]
    count: Int[Tensor, "b"]
    gathered: Float[Tensor, "b"]
    full_gathered: Float[Tensor, "b"]
    apart: Float[Tensor, "b"]
    asked_apart: Float[Tensor, "b"]
    elsewhere: Bool[Tensor, "b"]
    turn_unclear: Bool[Tensor, "b"]

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
    prediction: Prediction,
    fit: Fit,
    config: TrackerConfig,
    at_rest: Float[Tensor, "b"],
    full_gathered: Float[Tensor, "b"] | None = None,
    asked_apart: Float[Tensor, "b"] | None = None,
) -> Found:
    """A fit with its quality, by the motion that was found with it; without enough observations it explains nothing.

    Args:
        full_gathered: of when each object is seen well; zero, or none at all, where that is not known.
        asked_apart: how far apart directions have to be to count in full; zero, or none at all, for nothing asked.
    """
    moving = prediction.at(fit.solution.T_cam_obj, fit.solution.from_prior).moving(compensated=True)
    measured, gathered, apart = quality.shares(fit.contours, fit.matches, moving, prediction.objects.image_size, config.quality)
    # Of what does not move, events are noise.
    gathered = torch.where(measured.isnan(), torch.nan, gathered) if config.search.by_gathering else torch.full_like(measured, torch.nan)
    if asked_apart is not None:
        measured = measured * quality.held_all_ways(apart, asked_apart)
    nothing = torch.zeros_like(measured)
    full_gathered, asked_apart = (nothing if value is None else value for value in (full_gathered, asked_apart))
    return Found(fit, measured, at_rest, fit.matches.mask.sum(-1), gathered, full_gathered, apart, asked_apart, nothing.bool(), nothing.bool())


def explained_at_rest(widening: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """What an object explains that does not move: all, but nothing where it was looked for in many places.

    Args:
        widening: of each object's first gate.
    """
    return 2 - widening.clamp(1, 2)


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
    counts = (tried.count >= count.clamp(min=config.quality.min_observations)) & _is_likely(offset, covariance) & ~(tried.gathered < gathered)
    score = torch.where(counts, tried.score, 0)
    mine = torch.where(found.count[number] >= config.quality.min_observations, found.score[number], 0.0)
    asked = torch.maximum(mine + margin, needed)
    if config.search.line_ends and wide:
        score = _less_where_lines_run_on(score, score > asked, tried.fit.contours, places, one.objects.image_size)
    by_events = config.search.by_events and wide
    best = _likeliest(_by_events(score, tried.count) if by_events else score, offset, one.covariance[0])
    better = score.index_select(0, best) > asked
    return found if host_sync.none_of(better) else replaced(found, number, tried, best, better)


def is_taken(number: int, other: Found, found: Found) -> Bool[Tensor, ""]:
    """Whether a search found the object ``number`` in another pose; a GPU is not waited for to know."""
    return (other.fit.solution.T_cam_obj[number] != found.fit.solution.T_cam_obj[number]).any()


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


def _less_where_lines_run_on(
    score: Float[Tensor, "n"],
    concerned: Bool[Tensor, "n"],
    contours: Contours,
    places: tuple[Float[Tensor, "1 e 2"], Bool[Tensor, "1 e"]],
    image_size: tuple[int, int],
) -> Float[Tensor, "n"]:
    """Scores of poses, less where the lines that explain them are of something larger; of those alone that are ``concerned``, which saves time."""
    if host_sync.none_of(concerned):
        return score
    rows = concerned.nonzero()[:, 0] if host_sync.read_at_once(concerned) else torch.arange(len(score), device=score.device)
    return score.index_copy(0, rows, score[rows] * (1 - running_on(contours.rows(rows), places, image_size)))


def _by_events(score: Float[Tensor, "n"], count: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Scores of poses, less where fewer events are explained than by others: of small ones, far away, chance explains all."""
    matched = torch.where(score > 0, count, 0).to(score.dtype)
    return score * (matched / matched.max().clamp(min=1)).sqrt()


def _likeliest(score: Float[Tensor, "n"], from_prior: Float[Tensor, "n k"], covariance: Float[Tensor, "12 12"]) -> Int[Tensor, "1"]:
    """Of the poses that explain as much as the best does, the one that the prediction expects most: a turn of a vase explains nothing."""
    away = _squared_deviations(from_prior[:, :12], covariance)
    return torch.where(score >= score.max() - AS_MUCH, away.nan_to_num(torch.inf), torch.inf).argmin()[None]


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
