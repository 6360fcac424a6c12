"""What triggers are set by: what is known before a window is looked at, and what is measured once it is aligned."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation.scored_fit import ScoredFit


@dataclass(frozen=True)
class Schedule:
    """What is known of a window before it is looked at.

    Args:
        triggers: those of :class:`Trigger` that hang on the state alone.
        is_due: objects that it is time for, should they be very uncertain: looking more often does not help where an object is hidden.
        is_drift_due: objects that it is time to look for farther away, should there be reason to.
        is_near_due: objects that it is time for, should their place be known: always, but where looking has not helped for long.
    """

    triggers: Int[Tensor, "b"]
    is_due: Bool[Tensor, "b"]
    is_drift_due: Bool[Tensor, "b"]
    is_near_due: Bool[Tensor, "b"]


@dataclass(frozen=True)
class TriggerEvidence:
    """What the triggers are set by, once a window is aligned.

    Args:
        sigma_px: standard deviation of each object's prediction in the image (px).
        score: of the fit; ``last_score`` is that of the window before: a single window that is a little worse is no reason.
        mean_score: as a rule.
        reference_explained_ratio: what the object explains when it is seen well.
        drift_s: for how long it has explained too little by smeared events (s).
        time_since_validated_s: how long ago it was last seen well (s).
        looks: in how many windows it was looked for since then.
        is_starting: objects whose motion is not known yet.
        confirmations: of each object's pose before the window.
        measured_ratio: what the fit explains of the moving contour; not a number where hardly anything moves.
        is_due, is_drift_due, is_near_due: as :class:`Schedule` has them.
        triggers: that are set: those of the schedule at first, all once the conditions are met.
    """

    sigma_px: Float[Tensor, "b"]
    score: Float[Tensor, "b"]
    last_score: Float[Tensor, "b"]
    mean_score: Float[Tensor, "b"]
    reference_explained_ratio: Float[Tensor, "b"]
    drift_s: Float[Tensor, "b"]
    time_since_validated_s: Float[Tensor, "b"]
    looks: Int[Tensor, "b"]
    is_starting: Bool[Tensor, "b"]
    confirmations: Float[Tensor, "b"]
    measured_ratio: Float[Tensor, "b"]
    is_due: Bool[Tensor, "b"]
    is_drift_due: Bool[Tensor, "b"]
    is_near_due: Bool[Tensor, "b"]
    triggers: Int[Tensor, "b"]

    def stays_below(self, level: Float[Tensor, "b"]) -> Bool[Tensor, "b"]:
        """Whose score was below ``level`` in two windows in a row."""
        return torch.maximum(self.score, self.last_score) < level


def gather_evidence(
    state: TrackerState,
    window: Schedule,
    scored: ScoredFit,
    sigma_px: Float[Tensor, "b"],
    is_starting: Bool[Tensor, "b"],
) -> TriggerEvidence:
    """The evidence of a window that was aligned."""
    return TriggerEvidence(
        sigma_px=sigma_px,
        score=scored.score,
        last_score=state.health.score,
        mean_score=state.health.mean_score,
        reference_explained_ratio=state.health.reference_explained_ratio,
        drift_s=state.health.drift_s,
        time_since_validated_s=state.health.time_since_validated_s,
        looks=state.health.looks,
        is_starting=is_starting,
        confirmations=state.health.confirmations,
        measured_ratio=scored.measured_ratio,
        is_due=window.is_due,
        is_drift_due=window.is_drift_due,
        is_near_due=window.is_near_due,
        triggers=window.triggers,
    )
