"""Whether another pose is taken in the place of an object's own."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization.line_ends import running_on
from torchtrack.tracking.validation.scored_fit import Found

# Shares that differ by less are the same: which of them is larger is chance.
AS_MUCH = 0.02


# The 99th percentile of the squared distance of a pose, of six dimensions, in standard deviations (chi-square).
_LIKELY = 16.8


def is_taken(number: int, other: Found, found: Found) -> Bool[Tensor, ""]:
    """Whether a search found the object ``number`` in another pose; a GPU is not waited for to know."""
    return (other.fit.solution.T_cam_obj[number] != found.fit.solution.T_cam_obj[number]).any()


def is_likely(from_prior: Float[Tensor, "n k"], covariance: Float[Tensor, "12 12"]) -> Bool[Tensor, "n"]:
    """Which poses lie where all but one in a hundred of a covariance do: edges of what hides an object explain much of it, farther away."""
    return _squared_deviations(from_prior[:, :6], covariance[:6, :6]) < _LIKELY


def _squared_deviations(offsets: Float[Tensor, "n k"], covariance: Float[Tensor, "k k"]) -> Float[Tensor, "n"]:
    """Squared distance of offsets in standard deviations (Mahalanobis)."""
    root = torch.linalg.cholesky_ex(covariance).L
    return torch.linalg.solve_triangular(root, offsets.to(root.dtype).T, upper=False).square().sum(0)


def less_where_lines_run_on(
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


def scored_by_events(score: Float[Tensor, "n"], count: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Scores of poses, less where fewer events are explained than by others: of small ones, far away, chance explains all."""
    matched = torch.where(score > 0, count, 0).to(score.dtype)
    return score * (matched / matched.max().clamp(min=1)).sqrt()


def likeliest(score: Float[Tensor, "n"], from_prior: Float[Tensor, "n k"], covariance: Float[Tensor, "12 12"]) -> Int[Tensor, "1"]:
    """Of the poses that explain as much as the best does, the one that the prediction expects most: a turn of a vase explains nothing."""
    away = _squared_deviations(from_prior[:, :12], covariance)
    return torch.where(score >= score.max() - AS_MUCH, away.nan_to_num(torch.inf), torch.inf).argmin()[None]
