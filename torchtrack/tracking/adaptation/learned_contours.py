"""Contours that an object's model lacks, learned from its events: what is known of them, and whether they are needed.

A border whose colour equals what lies behind it fires nothing, while texture on the surface does. Without a contour for it,
the events of texture pull neighbouring contours onto themselves. :mod:`torchtrack.tracking.adaptation.surface_learning` finds such contours.
They count only for objects whose own contours turn out to explain little of what should be seen of them: what was learned
holds the errors of the poses it was learned at, and a good model needs none of it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.contours.objects import LearnedPoints
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.validation.measures import measured_ratio
from torchtrack.tracking.validation.scored_fit import ScoredFit

# The model's share that is assumed at first, how fast it follows, and how much more of it ends the need of learned contours.
_FIRST_SHARE, _SHARE_GAIN, _MORE_SHARE = 0.7, 0.2, 0.2
# Learned contours count once the model's own explain less than this share of themselves; where they explain the other one, nothing is learned.
_BELOW_RATIO, UP_TO_RATIO = 0.6, 0.8
# Unexplained events that are kept until they make a contour, per object, and evidence from which a learned contour counts: about the windows that
# confirmed it.
DRAFTS, TRUSTED_FROM = 4096, 3.0
# The first windows are all learned from, and after them one of so many, which saves time. None of these numbers was measured alone; without what is
# learned, errors on the 13 shared sequences are the same to 0.01° and 0.03 mm (docs/results.md): their models have their texture.
FIRST_WINDOWS, EVERY = 20, 10
# A start is in motion where contours are faster than this (px/s) in the first windows.
_CALM_PX_S, _START_WINDOWS = 100.0, 2


@dataclass(frozen=True)
class LearnedContours:
    """What was learned of each object.

    Args:
        drafts_obj: the last unexplained events on its surface, in its frame (m).
        drafted: how many were ever written; they are written round and round.
        points_obj: learned contour points (m).
        tangents_obj: unit directions of the contour there.
        evidence: how far each is confirmed; zero for none.
        model_share: share of the model's own moving contours that events explain, its running mean.
        needed: whether the model's own contours explain too little.
        windows: windows taken so far.
    """

    drafts_obj: Float[Tensor, "b r 3"]
    drafted: Int[Tensor, "b"]
    points_obj: Float[Tensor, "b n 3"]
    tangents_obj: Float[Tensor, "b n 3"]
    evidence: Float[Tensor, "b n"]
    model_share: Float[Tensor, "b"]
    needed: Bool[Tensor, "b"]
    windows: int

    @classmethod
    def none(cls, batch: int, count: int, like: Tensor) -> "LearnedContours":
        """Nothing learned yet, with places for ``count`` points of each object."""
        drafts, points = like.new_zeros(batch, DRAFTS, 3), like.new_zeros(batch, count, 3)
        drafted = torch.zeros(batch, dtype=torch.int64, device=like.device)
        share = like.new_full((batch,), _FIRST_SHARE)
        return cls(drafts, drafted, points, points, points[..., 0], share, drafted == 0, 0)

    def but_of(self, chosen: Bool[Tensor, "b"], other: "LearnedContours") -> "LearnedContours":
        """The same, but of some objects what another knows."""
        rows: dict[str, Any] = {
            name: torch.where(chosen.view(-1, *[1] * (value.dim() - 1)), getattr(other, name), value) for name, value in self._of_each().items()
        }
        return replace(self, **rows)

    def rows(self, chosen: Int[Tensor, "k"]) -> "LearnedContours":
        """What is known of some objects."""
        return replace(self, **{name: value[chosen] for name, value in self._of_each().items()})

    def with_rows(self, chosen: Int[Tensor, "k"], other: "LearnedContours") -> "LearnedContours":
        """The same, but of some objects what another knows, of which these are all."""
        rows: dict[str, Any] = {name: value.index_copy(0, chosen, getattr(other, name)) for name, value in self._of_each().items()}
        return replace(self, **rows)

    def _of_each(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if torch.is_tensor(value)}

    def points(self, least: float) -> LearnedPoints:
        """The learned points with at least that evidence."""
        return LearnedPoints(self.points_obj, self.tangents_obj, self.evidence >= least)

    def that_count(self) -> LearnedPoints:
        """The points that are confirmed, of objects whose models do not explain their events."""
        points = self.points(TRUSTED_FROM)
        return replace(points, mask=points.mask & self.needed[:, None])

    def wanted(self, on_surfaces: Bool[Tensor, "b"]) -> Bool[Tensor, "b"] | None:
        """Objects to learn of in this window: those whose models may lack contours, of ``on_surfaces``; None where it is not due."""
        return on_surfaces & (self.model_share < UP_TO_RATIO) if self.due() else None

    def due(self) -> bool:
        """Whether this window may be learned from: all of the first ones, and then some."""
        return self.windows < FIRST_WINDOWS or self.windows % EVERY == 0


def judge_model(
    learned: LearnedContours,
    scored: ScoredFit,
    velocity: Callable[[Contours], Tensor],
    image_sizes: Int[Tensor, "b 2"],
    config: TrackerConfig,
    *,
    any_count: bool,
) -> LearnedContours:
    """Whether a model's own contours explain what is seen, after a window's fit.

    An object that hardly moves at first shows its contours at the very pose that was given: these count at once, until the
    model's own explain enough. What is learned from a start in motion waits until they are seen to explain too little.

    Args:
        velocity: gives the image velocity of contours (px/s).
        any_count: whether any learned contours were among those of the fit.
    """
    contours = scored.fit.contours
    share = _share_of_own(scored, velocity(contours), image_sizes, config) if any_count else scored.measured_ratio
    known = torch.isfinite(share) & (scored.count > 0)
    share = torch.where(known, torch.lerp(learned.model_share, share, _SHARE_GAIN), learned.model_share)
    enough = share > _BELOW_RATIO + _MORE_SHARE
    if learned.windows < _START_WINDOWS:
        enough = enough | _in_motion(contours, velocity(contours))
    return replace(learned, model_share=share, needed=(learned.needed & ~enough) | (share < _BELOW_RATIO))


def _share_of_own(scored: ScoredFit, velocity: Float[Tensor, "b m 2"], image_sizes: Int[Tensor, "b 2"], config: TrackerConfig) -> Float[Tensor, "b"]:
    """Share of the moving contours of the model itself that events explain; not a number where hardly any move."""
    contours, matches = scored.fit.contours, scored.fit.matches
    own = contours.kind != int(ContourKind.LEARNED)
    matches = replace(matches, near=matches.near & own.gather(1, matches.contour))
    return measured_ratio(replace(contours, mask=contours.mask & own), matches, velocity, image_sizes, config)


def _in_motion(contours: Contours, velocity: Float[Tensor, "b m 2"]) -> Bool[Tensor, "b"]:
    """Which objects' contours move."""
    u, v = velocity.unbind(-1)
    own = contours.mask & (contours.kind != int(ContourKind.LEARNED))
    speed_px_s = ((u * u + v * v).sqrt() * own).sum(-1) / own.sum(-1).clamp(min=1)
    return speed_px_s > _CALM_PX_S
