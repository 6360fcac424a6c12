"""Which hypotheses answer which triggers, in the order in which they are tried, and the test that each has to pass."""

from collections.abc import Callable
from dataclasses import dataclass

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.relocalization import acceptance, hypotheses, rivals
from torchtrack.tracking.relocalization.acceptance import Acceptance
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.hypotheses import Hypotheses
from torchtrack.tracking.relocalization.lost_objects import LostObjects
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, AROUND_PREDICTION, Trigger
from torchtrack.tracking.validation.scored_fit import ScoredFit


@dataclass(frozen=True)
class Source:
    """Hypotheses that some triggers call for.

    Args:
        triggers: any of which calls for them.
        propose: the hypotheses of some objects.
        test: what is asked of them, of each object, before any are tried.
        in_two_ways: whether objects that hardly anything is known of are looked for in another way than others, and so apart from them.
        comes_last: whether they are tried once all others were, and what these gave is settled.
    """

    triggers: Trigger
    propose: Callable[[LostObjects], Hypotheses]
    test: Callable[[TriggerEvidence, ScoredFit, TrackerConfig], Acceptance]
    in_two_ways: bool = False
    comes_last: bool = False

    def is_called_for(self, flags: int) -> bool:
        """Whether an object with these triggers is to be tried there."""
        return bool(flags & self.triggers)


SOURCES = (
    Source(AROUND_PREDICTION, hypotheses.around_prediction, acceptance.near_prediction, in_two_ways=True),
    Source(AROUND_LAST_SEEN, hypotheses.around_last_seen, acceptance.around_last_seen, comes_last=True),
    Source(Trigger.UNCONFIRMED, rivals.turned_far, rivals.explains_far_more, comes_last=True),
)
