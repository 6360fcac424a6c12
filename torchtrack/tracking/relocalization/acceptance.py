"""What is asked of a hypothesis to be taken in the place of an object's own pose: a test for each reason to try others."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.field_values import field_values
from torchtrack.core.padded import repeated, rows_in_all
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization.event_image import Places
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.hypotheses import Hypotheses
from torchtrack.tracking.relocalization.line_ends import running_on
from torchtrack.tracking.relocalization.lost_objects import LostObjects
from torchtrack.tracking.relocalization.triggers import DRIFTS, Trigger, has
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.verdict import AGREES_FROM, VALIDATED_FROM

# Ratios that differ by less are the same: which of them is larger is chance.
AS_MUCH = 0.02
# By how much the score of another pose must be better while a motion is not known; and where the pose is not near the prediction. Not measured
# alone.
_START_MARGIN, _ELSEWHERE_MARGIN = 0.02, 0.15
# Share of what an object explains when seen well that is asked of a pose farther away. Not measured alone.
_DRIFT_MIN_RATIO = 0.65
# The 99th percentile of the squared distance of a pose, of six dimensions, in standard deviations (chi-square).
_LIKELY = 16.8
# What explains so many times as many events as a pose far off in depth is no smaller thing that chance explains.
_FAR_MORE = 2.0


@dataclass(frozen=True)
class Choice:
    """Which of each object's hypotheses is the best.

    Args:
        row: of the best, among those of all objects.
        is_accepted: whether it takes the place of the object's own pose.
    """

    row: Int[Tensor, "k"]
    is_accepted: Bool[Tensor, "k"]


@runtime_checkable
class Acceptance(Protocol):
    """Chooses between hypotheses."""

    def rows(self, chosen: Int[Tensor, "k"]) -> "Acceptance":
        """What is asked of some objects."""

    def choose(self, tried: ScoredFit, hypotheses: Hypotheses, lost: LostObjects) -> Choice:
        """The best of each object's hypotheses, and whether it is accepted."""


@dataclass(frozen=True)
class AcceptanceTest:
    """What a hypothesis has to be to be accepted.

    Args:
        margin: by how much its score has to be larger than that of the object's own pose.
        min_score: how large it has to be at least.
        min_inlier_ratio: how much of the events around its contours has to be on them; what cannot be told passes.
        min_matches: how many observations it has to match.
    """

    margin: Float[Tensor, "b"]
    min_score: Float[Tensor, "b"]
    min_inlier_ratio: Float[Tensor, "b"]
    min_matches: Float[Tensor, "b"]

    def rows(self, chosen: Int[Tensor, "k"]) -> "AcceptanceTest":
        """What is asked of some objects."""
        return AcceptanceTest(*(value.index_select(0, chosen) for value in field_values(self).values()))

    def choose(self, tried: ScoredFit, hypotheses: Hypotheses, lost: LostObjects) -> Choice:
        """The hypothesis with the best score, and of those about as good the one that the prediction expects most."""
        config, prediction, offsets = lost.config, hypotheses.prediction, tried.fit.solution.from_prior
        own = lost.window.scored
        eligible = self.is_passed(tried, config) & is_likely(offsets, hypotheses.covariance)
        eligible = eligible & ~is_contradicted(tried, own.texture_agreement[lost.rows])
        score, asked = torch.where(eligible, tried.score, 0), self.asked_score(own.count[lost.rows], own.score[lost.rows], config)
        if config.uses(Component.LINE_ENDS) and hypotheses.is_wide:
            concerned = score > repeated(asked, len(score))
            score = less_where_lines_run_on(score, concerned, tried.fit.contours, hypotheses.places, prediction.objects.image_size)
        best = likeliest(score, offsets, prediction.covariance)
        return Choice(best, score.index_select(0, best) > asked)

    def is_passed(self, tried: ScoredFit, config: TrackerConfig) -> Bool[Tensor, "n"]:
        """Which hypotheses match enough observations that gather enough."""
        least = self.min_matches.clamp(min=config.validation.min_observations)
        # Written so that what does not tell how far it gathers passes.
        gathers = ~(tried.inlier_ratio < repeated(self.min_inlier_ratio, len(tried.count)))
        return (tried.count >= repeated(least, len(tried.count))) & gathers

    def asked_score(self, own_count: Int[Tensor, "k"], own_score: Float[Tensor, "k"], config: TrackerConfig) -> Float[Tensor, "k"]:
        """The score that has to be surpassed: by so many matched observations, each object's own pose has so much."""
        own = torch.where(own_count >= config.validation.min_observations, own_score, 0.0)
        return torch.maximum(own + self.margin, self.min_score)


# ---- the tests


def near_prediction(evidence: TriggerEvidence, scored: ScoredFit, config: TrackerConfig) -> AcceptanceTest:
    """Of poses around the prediction.

    While a motion is not known nothing says how far events gather when all is well, and dense print explains as much of many poses:
    a pose that smears the events more than the prediction's own is not better.
    """
    search, starting, reference = config.relocalization, evidence.is_starting, evidence.reference_explained_ratio
    margin = torch.where(starting, _START_MARGIN, search.accept_margin)
    # What is far away has to explain about as much as usual; so has what is reached step by step, while a motion is lost, ever farther away.
    min_score = torch.where(has(evidence.triggers, DRIFTS) | starting, _DRIFT_MIN_RATIO * reference, 0)
    # What is partly hidden explains less, too: nothing but the whole object, seen elsewhere by no fewer events, speaks against that.
    # A part of its edges does not.
    slow = has(evidence.triggers, Trigger.SLOW_DRIFT)
    margin = torch.where(slow, _ELSEWHERE_MARGIN, margin)
    min_score = torch.where(slow, search.accept_ratio * reference, min_score)
    # Of a new object, only what explains nearly all is surely better: edges of what hides it explain half.
    new = has(evidence.triggers, Trigger.NEW)
    min_score = torch.where(new, search.new_below, min_score)
    min_inlier_ratio = torch.where(starting | new, scored.inlier_ratio.nan_to_num(0.0) - AS_MUCH, 0)
    return AcceptanceTest(margin, min_score, min_inlier_ratio, torch.where(slow, _matches(scored), 0))


def around_last_seen(evidence: TriggerEvidence, scored: ScoredFit, config: TrackerConfig) -> AcceptanceTest:
    """Of poses all around where the object was last validated.

    A small thing that is all explained says nothing against a pose of which far more events are explained. What is partly hidden does.
    """
    changed, search = has(evidence.triggers, Trigger.DEPTH_CHANGED), config.relocalization
    margin = torch.where(changed, -torch.inf, _ELSEWHERE_MARGIN)
    min_score = torch.where(changed, VALIDATED_FROM, search.accept_ratio) * evidence.reference_explained_ratio
    min_matches = torch.where(changed, _FAR_MORE, 1) * _matches(scored)
    return AcceptanceTest(margin, min_score, torch.zeros_like(min_score), min_matches)


def _matches(scored: ScoredFit) -> Float[Tensor, "b"]:
    return scored.count.to(scored.score.dtype)


# ---- what they compare


def is_contradicted(tried: ScoredFit, own_agreement: Float[Tensor, "k"]) -> Bool[Tensor, "n"]:
    """Which poses events on texture contradict, where they agree at the object's own pose; where motion is not known yet, they do at no pose."""
    return repeated(own_agreement >= AGREES_FROM, len(tried.count)) & (tried.texture_agreement < AGREES_FROM)


def is_likely(from_prior: Float[Tensor, "n d"], covariance: Float[Tensor, "k 12 12"]) -> Bool[Tensor, "n"]:
    """Which poses lie where all but one in a hundred of a covariance do: edges of what hides an object explain much of it, farther away."""
    return _squared_deviations(from_prior[:, :6], covariance[:, :6, :6]) < _LIKELY


def _squared_deviations(offsets: Float[Tensor, "n d"], covariance: Float[Tensor, "k d d"]) -> Float[Tensor, "n"]:
    """Squared distance of offsets in standard deviations (Mahalanobis)."""
    root = torch.linalg.cholesky_ex(covariance).L
    of_objects = offsets.to(root.dtype).unflatten(0, (len(root), -1)).mT
    return torch.linalg.solve_triangular(root, of_objects, upper=False).square().sum(1).flatten()


def less_where_lines_run_on(
    score: Float[Tensor, "n"],
    concerned: Bool[Tensor, "n"],
    contours: Contours,
    places: Places,
    image_size: tuple[int, int],
) -> Float[Tensor, "n"]:
    """Scores of poses, less where the lines that explain them are of something larger; of those alone that are ``concerned``, which saves time."""
    if host_sync.none_of(concerned):
        return score
    rows = concerned.nonzero()[:, 0] if host_sync.read_at_once(concerned) else torch.arange(len(score), device=score.device)
    number = rows // (len(score) // len(places[0]))
    return score.index_copy(0, rows, score[rows] * (1 - running_on(contours.rows(rows), number, places, image_size)))


def likeliest(score: Float[Tensor, "n"], from_prior: Float[Tensor, "n d"], covariance: Float[Tensor, "k 12 12"]) -> Int[Tensor, "k"]:
    """Of the poses that explain as much as the best does, the one that the prediction expects most: a rotation of a vase explains nothing."""
    score, away = (value.unflatten(0, (len(covariance), -1)) for value in (score, _squared_deviations(from_prior, covariance)))
    as_good = score >= score.amax(1, keepdim=True) - AS_MUCH
    best = torch.where(as_good, away.nan_to_num(torch.inf), torch.inf).argmin(1, keepdim=True)
    return rows_in_all(best, score.shape[1])
