"""Tentative poses: that of an object of which hardly anything was known may be wrong, and is confirmed or taken back by what follows.

Of thousands of poses some explain much by chance now and then, above all while the object is still hidden. So where it was
looked for is kept, until the new pose has explained about as much as is usual for some windows, or too little.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.tracking.estimation.rounds import may_be_anywhere
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.validation.health import TentativeTrack
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import VALIDATED_FROM

# A window speaks for a pose by its ratio of what is wanted, as far as it is more than this.
_NEUTRAL = 0.6
# Windows' worth of evidence at which a pose is confirmed or taken back.
_CONFIRMED_AT, _TAKEN_BACK_AT = 3.0, -1.5


def confirm_or_take_back(
    before: TrackerState, state: TrackerState, result: StepResult, prediction: Prediction, gate_scale: Float[Tensor, "b"], config: TrackerConfig
) -> tuple[TrackerState, StepResult]:
    """State and result of a window, with tentative poses taken back that did not prove themselves.

    Args:
        before: the state before the window.
        state, result: after it.
        prediction: of the objects, with the ``gate_scale`` of their first gates.
    """
    concerned = before.tentative.is_tentative | may_be_anywhere(gate_scale)
    if host_sync.none_of(concerned):
        return state, result
    tentative = _begun(before, result, prediction, gate_scale)
    wanted = VALIDATED_FROM * before.health.reference_explained_ratio
    speaks_for = (result.quality / wanted.clamp(min=1e-3)).clamp(max=1) - _NEUTRAL
    evidence = tentative.evidence + speaks_for
    wrong = tentative.is_tentative & (evidence <= _TAKEN_BACK_AT)
    goes_on = tentative.is_tentative & ~wrong & (evidence < _CONFIRMED_AT)
    # The next tentative pose of the object begins without any.
    tentative = replace(tentative, is_tentative=goes_on, evidence=torch.where(goes_on, evidence, 0))
    state = replace(state, motion=state.motion.at_rest(wrong, tentative.T_cam_obj, tentative.covariance), tentative=tentative)
    lost = torch.where(wrong & (result.status < int(Status.LOST)), int(Status.LOST), result.status)
    return state, replace(result, status=lost)


def _begun(before: TrackerState, result: StepResult, prediction: Prediction, gate_scale: Float[Tensor, "b"]) -> TentativeTrack:
    """What is tentative with those objects that this window gave a pose although hardly anything was known of them."""
    old = before.tentative
    begins = ~old.is_tentative & may_be_anywhere(gate_scale) & (result.status < int(Status.LOST))
    first = begins[:, None, None]
    return TentativeTrack(
        is_tentative=old.is_tentative | begins,
        evidence=old.evidence,
        T_cam_obj=torch.where(first, prediction.T_cam_obj.to(old.T_cam_obj.dtype), old.T_cam_obj),
        covariance=torch.where(first, prediction.covariance, old.covariance),
    )
