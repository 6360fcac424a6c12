"""What relocalization works on, for its tests: evidence for triggers, and objects that other poses are tried for."""

import torch

from torchtrack.tracking.relocalization import hypotheses, last_seen, schedule, triggers
from torchtrack.tracking.relocalization.acceptance import AcceptanceTest
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.last_seen import LastSeen
from torchtrack.tracking.relocalization.lost_objects import LostObjects, Relocalized
from torchtrack.tracking.relocalization.refine import exchanged, refined

# Of an object that is seen well, in a window in which it is time for nothing.
SEEN_WELL = {
    "sigma_px": 1.0,
    "score": 0.9,
    "last_score": 0.9,
    "mean_score": 0.9,
    "reference_explained_ratio": 0.9,
    "drift_s": 0.0,
    "time_since_validated_s": 0.0,
    "looks": 0,
    "is_starting": False,
    "confirmations": 4.0,
    "measured_ratio": 0.9,
    "is_due": False,
    "is_drift_due": False,
    "is_near_due": True,
    "triggers": 0,
}


def evidence(count=1, **changes):
    """Evidence of objects that are seen well, but for what is changed: by a value for all of them, or a list of one for each."""
    values = {name: torch.as_tensor(value).expand(count) for name, value in (SEEN_WELL | changes).items()}
    return TriggerEvidence(**values)


def acceptance_test(margin=0.1, min_score=0.0, min_inlier_ratio=0.0, min_matches=0.0):
    """A test for a single object."""
    return AcceptanceTest(*(torch.tensor([value]) for value in (margin, min_score, min_inlier_ratio, min_matches)))


def lost_object(tracker, prediction, seen, scored, sigma_px, config=None):
    """The first object of a tracker, to try other poses for."""
    return LostObjects(
        numbers=(0,),
        window=Relocalized(scored, prediction, torch.ones_like(scored.score)),
        widened=prediction,
        sigma_px=torch.full_like(scored.score[:1], sigma_px),
        is_wide=sigma_px > tracker.config.relocalization.wide_sigma_px,
        events=seen.of_objects(torch.tensor([0])),
        last_seen=LastSeen(prediction.T_cam_obj.double(), prediction.covariance),
        config=config or tracker.config,
    )


def searched(lost, test=None, propose=hypotheses.around_prediction):
    """The fits of a window with other poses tried for the object."""
    proposed = propose(lost)
    tried = refined(proposed, lost)
    choice = (test or acceptance_test()).rows(lost.rows).choose(tried, proposed, lost)
    return exchanged(lost, proposed, tried, choice).scored


def drifting_soon(monkeypatch, diameters_s=1.5):
    """What drifts is looked for after 10 ms, as far as it may have gone by then, and never rarer: a slip of some windows is enough."""
    monkeypatch.setattr(triggers, "DRIFT_US", 10_000)
    monkeypatch.setattr(schedule, "DRIFT_US", 10_000)
    monkeypatch.setattr(schedule, "_HALVED_FROM_S", (float("inf"),) * len(schedule._HALVED_FROM_S))
    monkeypatch.setattr(last_seen, "_DRIFT_DIAMETERS_S", diameters_s)
