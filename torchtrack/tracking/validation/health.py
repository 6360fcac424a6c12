"""How well each object was seen so far."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.tracking.validation.verdict import Limits, References, looked_elsewhere


@dataclass(frozen=True)
class TrackHealth:
    """How well each object is seen, against how well it was when its pose was right.

    References are running means that rise as fast as what they follow, but fall slowly.

    Args:
        score: of the last window, :attr:`torchtrack.tracking.validation.scored_fit.ScoredFit.score`.
        mean_score: its running mean; zero of an object that was never seen.
        reference_explained_ratio: of the moving contour, what events explain when the object is seen well.
        reference_inlier_ratio: of the events near its contours, how many are on them then.
        reference_normal_spread: how far the normals of contours with events on them are spread then
            (:func:`torchtrack.tracking.validation.measures.normal_spread`).
        drift_s: for how long, less the time it was not, the object has explained too little by smeared events (s).
        T_last_validated: pose of each object when it was last seen well (float64).
        time_since_validated_s: how long ago that was (s).
        looks: in how many windows other poses of it were tried since then.
        confirmations: windows that speak for the pose that the object started from, or was given by a search
            (:func:`torchtrack.tracking.validation.verdict.confirmations`).
    """

    score: Float[Tensor, "b"]
    mean_score: Float[Tensor, "b"]
    reference_explained_ratio: Float[Tensor, "b"]
    reference_inlier_ratio: Float[Tensor, "b"]
    reference_normal_spread: Float[Tensor, "b"]
    drift_s: Float[Tensor, "b"]
    T_last_validated: Float[Tensor, "b 4 4"]
    time_since_validated_s: Float[Tensor, "b"]
    looks: Int[Tensor, "b"]
    confirmations: Float[Tensor, "b"]

    def with_looks(self, looked: Bool[Tensor, "b"] | None) -> "TrackHealth":
        """The same after a window in which objects were looked for; nobody where not given."""
        looks = self.looks if looked is None else self.looks + looked
        return replace(self, looks=torch.where(self.time_since_validated_s == 0, 0, looks))

    def after_looks(self, looked: Bool[Tensor, "b"], is_unconfirmed: Bool[Tensor, "b"], limits: Limits) -> "TrackHealth":
        """The same after a search, which confirms the poses of which no more was asked than whether another one explains far more."""
        confirmations = looked_elsewhere(self.confirmations, looked & is_unconfirmed, limits)
        return replace(self.with_looks(looked), confirmations=confirmations)

    @property
    def references(self) -> References:
        """What a verdict goes by, and changes."""
        return References(*(getattr(self, name) for name in References._fields))

    @classmethod
    def unknown(cls, T_cam_obj: Float[Tensor, "b 4 4"], dtype: torch.dtype) -> "TrackHealth":
        """Of objects that no window has been seen of yet, at these poses."""
        zero = torch.zeros(len(T_cam_obj), dtype=dtype, device=T_cam_obj.device)
        return cls(
            score=zero,
            mean_score=zero,
            reference_explained_ratio=zero,
            reference_inlier_ratio=zero,
            reference_normal_spread=zero,
            drift_s=zero,
            T_last_validated=T_cam_obj.clone(),
            time_since_validated_s=zero,
            looks=torch.zeros_like(zero, dtype=torch.int64),
            confirmations=zero,
        )
