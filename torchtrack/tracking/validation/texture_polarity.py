"""What the polarity of events on texture says of a pose: on the right one they agree on its dark side, on another as many say this as that.

Dense print explains much of the events at many poses, and no measure of how much tells these apart.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.core.host_sync import none_of
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.association.weights import on_and_around
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.validation.health import TrackHealth
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.verdict import Limits

# Events on texture that agree less than this, in the mean, speak against a pose. Of 742 windows of poses within 5 degrees, 95 % agree 0.80 or more,
# and 99 % 0.73; of 961 of poses that were more than 20 degrees off, 95 % agree 0.70 or less, and 99 % 0.78.
AGREES_FROM = 0.75


def contradicts(contours: Contours, matches: Matches, limits: Limits) -> Bool[Tensor, "b"]:
    """Objects on whose texture too many events say that its other side is the darker one; too few events say nothing."""
    kind = contours.kind.gather(1, matches.contour)
    on = on_and_around(matches.offsets, matches.near)[:, 0] * (kind == int(ContourKind.TEXTURE))
    count = on.sum(-1)
    return (count >= limits.min_observations) & ((on * matches.as_expected).sum(-1) < AGREES_FROM * count)


def without_contradicted(health: TrackHealth, scored: ScoredFit, limits: Limits) -> TrackHealth:
    """The health of objects after a window, which speaks for no pose that is not confirmed yet and that texture contradicts."""
    waits = health.confirmations < limits.confirmed_by
    if none_of(waits):
        return health
    # What was relocalized stands on other matches than these.
    contradicted = waits & ~scored.is_relocalized & contradicts(scored.fit.contours, scored.fit.matches, limits)
    return replace(health, confirmations=torch.where(contradicted, 0, health.confirmations))
