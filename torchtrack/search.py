"""Many poses tried at once, where one prediction is too uncertain: after an occlusion, or when a pose begins to slip.

The most promising of thousands (:mod:`torchtrack.hypotheses`) are aligned as one batch; the one that explains most is taken.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack import quality, readback
from torchtrack.alignment import Fit, align, index_for
from torchtrack.config.tracker import SearchConfig, TrackerConfig
from torchtrack.contours import Contours
from torchtrack.hypotheses import event_density, promising
from torchtrack.observations import WindowEvents, select_events
from torchtrack.once import once
from torchtrack.pose_solver import Linearisation
from torchtrack.prediction import Prediction
from torchtrack.readback import Answer

# Shares that differ by less are the same: which of them is larger is chance.
_AS_MUCH = 0.02


@dataclass(frozen=True)
class Found:
    """What one window gave for each object.

    Args:
        fit: poses, and what they stand on.
        measured: share of the moving contour that events explain; not a number where hardly anything moves.
        at_rest: what stands for it then.
        count: matched observations.
    """

    fit: Fit
    measured: Float[Tensor, "b"]
    at_rest: Float[Tensor, "b"]
    count: Int[Tensor, "b"]

    @once
    def share(self) -> Float[Tensor, "b"]:
        """What events explain of the contour."""
        return torch.where(self.measured.isnan(), self.at_rest, self.measured)


def judge_fit(prediction: Prediction, fit: Fit, config: TrackerConfig, at_rest: Float[Tensor, "b"]) -> Found:
    """A fit with its quality, by the motion that was found with it; without enough observations it explains nothing."""
    velocity = prediction.at(fit.solution.T_cam_obj, fit.solution.from_prior).contour_velocity(fit.contours)
    measured = quality.measured_share(fit.contours, fit.matches, velocity, prediction.objects.image_size, config.quality)
    return Found(fit, measured, at_rest, fit.matches.mask.sum(-1))


def explained_at_rest(widening: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """What an object explains that does not move: all, but nothing where it was looked for in many places.

    Args:
        widening: of each object's first gate.
    """
    return 2 - widening.clamp(1, 2)


@dataclass(frozen=True)
class Doubt:
    """What speaks for trying other poses, before a window is aligned.

    Args:
        sigma_px: standard deviation of each object's prediction in the image.
        last_share: explained in the window before: one bad window alone is no reason.
        usual_share: explained as a rule.
        starting: objects whose motion is not known yet.
        due: objects that it is time for, should they be very uncertain: what is hidden is not found by looking more often.
    """

    sigma_px: Float[Tensor, "b"]
    last_share: Float[Tensor, "b"]
    usual_share: Float[Tensor, "b"]
    starting: Bool[Tensor, "b"]
    due: Bool[Tensor, "b"]

    def asks(self, share: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects are to be searched for: uncertain ones, and those whose explained share stays below the usual."""
        starting = self.starting if config.at_start else torch.zeros_like(self.starting)
        due = self.due | (self.sigma_px <= config.wide_sigma_px)
        return starting | (due & ((self.sigma_px > config.from_sigma_px) | (share < config.dropped_to * self.usual_share)))


def search_is_due(since_us: Int[Tensor, "s"], t_us: Int[Tensor, "s"], config: SearchConfig) -> Bool[Tensor, "s"]:
    """Streams in which it is time to search for what is very uncertain: by the clock, whatever the windows."""
    interval_us = max(config.interval_us, 1)
    return t_us // interval_us > since_us // interval_us


def may_be_wanted(doubt: Doubt, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects :func:`search_wanted` can turn out to search for, as far as is known before the window is aligned."""
    if config.search.hypotheses == 0 or not config.solver.prior:
        return torch.zeros_like(doubt.starting)
    return doubt.asks(doubt.last_share, config.search)


def search_wanted(prediction: Prediction, doubt: Doubt, events: WindowEvents, found: Found, config: TrackerConfig) -> Found:
    """Try other poses for the objects that need it, one object after the other."""
    if config.search.hypotheses == 0 or not config.solver.prior:
        return found
    # Without events no pose is better than another.
    enough = events.mask.sum(-1) >= config.quality.min_observations
    tried = enough & doubt.asks(torch.maximum(found.share, doubt.last_share), config.search)
    margin = torch.where(doubt.starting, config.search.start_margin, config.search.margin)
    answers = Answer.to(tried), Answer.to(doubt.sigma_px)
    for number, (is_tried, own_sigma_px) in enumerate(zip(*(answer.numbers() for answer in answers), strict=True)):
        if is_tried:
            found = search(number, prediction, own_sigma_px, margin[number], events, found, config)
    return found


def search(
    number: int, prediction: Prediction, sigma_px: float, margin: Float[Tensor, ""], events: WindowEvents, found: Found, config: TrackerConfig
) -> Found:
    """Try other poses for the object ``number``; ``found`` with the best of them in its place, if that is better.

    Args:
        sigma_px: standard deviation of the object's prediction in the image.
        margin: by how much another pose must explain more.
        events: of all objects.
    """
    settings = config.search
    widened_px = max(sigma_px, settings.least_sigma_px)
    covariance = prediction.covariance[number] * (widened_px / max(sigma_px, 1e-6)) ** 2
    one, seen = prediction.copies(number, 1), events.of(number)
    density = event_density(one.carried(seen.pixels, seen.age_s), seen.mask, prediction.objects.image_size)
    offsets = promising(one, found.fit.contours.of(number), covariance, widened_px, density, config)
    tried = _align_all(prediction.copies(number, len(offsets)), offsets, seen, config)
    share = torch.where(tried.count >= config.quality.min_observations, tried.share, 0)
    best = _likeliest(share, tried.fit.solution.from_prior, prediction.covariance[number])
    mine = torch.where(found.count[number] >= config.quality.min_observations, found.share[number], 0.0)
    better = share.index_select(0, best) > mine + margin
    return found if readback.none_of(better) else _replaced(found, number, tried, best, better)


def _likeliest(share: Float[Tensor, "n"], from_prior: Float[Tensor, "n k"], covariance: Float[Tensor, "12 12"]) -> Int[Tensor, "1"]:
    """Of the poses that explain as much as the best does, the one that the prediction expects most: a turn of a vase explains nothing."""
    root = torch.linalg.cholesky_ex(covariance).L
    away = torch.linalg.solve_triangular(root, from_prior[:, :12].to(root.dtype).T, upper=False).square().sum(0)
    return torch.where(share >= share.max() - _AS_MUCH, away.nan_to_num(torch.inf), torch.inf).argmin()[None]


def _align_all(copies: Prediction, offsets: Tensor, seen: WindowEvents, config: TrackerConfig) -> Found:
    """Align copies of one object, each from its own offset, on the events of the object."""
    begin = copies.moved(offsets)
    contours = copies.objects.contours(begin.T_cam_obj, config.contours)
    tight = torch.ones_like(offsets[:, 0])
    index = index_for(contours, copies.objects.image_size, config, tight)
    events = seen.repeated(len(offsets))
    observations = select_events(events, index, begin.plane_velocity(events.pixels), config.matching.max_events)
    return judge_fit(copies, align(copies, contours, index, tight, observations, config, offsets), config, torch.zeros_like(tight))


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
    values = (put(getattr(found, name), getattr(other, name)) for name in ("measured", "at_rest", "count"))
    return Found(Fit(solution, contours, mine.matches), *values)
