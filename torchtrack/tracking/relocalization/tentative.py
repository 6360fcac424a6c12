"""Tentative poses: what was found of an object that was hardly known anything of may be wrong, and then has to be taken back.

Of thousands of poses one explains much by chance now and then, above all while the object is still hidden. So where it was
looked for is kept, until what was found has explained about as much as is usual for some windows, or too little.
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

# A window speaks for a find by its share of what is wanted, as far as it is more than this.
_NEUTRAL = 0.6
# Windows' worth of evidence at which a find is kept or taken back.
_KEPT_AT, _TAKEN_BACK_AT = 3.0, -1.5


def confirmed(
    before: TrackerState, state: TrackerState, result: StepResult, prediction: Prediction, gate_scale: Float[Tensor, "b"], config: TrackerConfig
) -> tuple[TrackerState, StepResult]:
    """State and result of a window, with finds taken back that did not prove themselves.

    Args:
        before: the state before the window.
        state, result: after it.
        prediction: of the objects, with ``gate_scale`` of their first gates.
    """
    concerned = before.tentative.is_tentative | may_be_anywhere(gate_scale)
    if host_sync.none_of(concerned):
        return state, result
    tentative = _begun(before, result, prediction, gate_scale)
    wanted = config.validation.validated_from * before.health.reference_explained_ratio
    speaks_for = (result.quality / wanted.clamp(min=1e-3)).clamp(max=1) - _NEUTRAL
    evidence = tentative.evidence + speaks_for
    wrong = tentative.is_tentative & (evidence <= _TAKEN_BACK_AT)
    runs = tentative.is_tentative & ~wrong & (evidence < _KEPT_AT)
    # The next find of the object begins without any.
    tentative = replace(tentative, is_tentative=runs, evidence=torch.where(runs, evidence, 0))
    state = replace(state, motion=state.motion.at_rest(wrong, tentative.T_cam_obj, tentative.covariance), tentative=tentative)
    lost = torch.where(wrong & (result.status < int(Status.LOST)), int(Status.LOST), result.status)
    return state, replace(result, status=lost)


def _begun(before: TrackerState, result: StepResult, prediction: Prediction, gate_scale: Float[Tensor, "b"]) -> TentativeTrack:
    """The tentative poses of those objects that were found in this window although hardly anything was known of them."""
    old = before.tentative
    begins = ~old.is_tentative & may_be_anywhere(gate_scale) & (result.status < int(Status.LOST))
    first = begins[:, None, None]
    return TentativeTrack(
        is_tentative=old.is_tentative | begins,
        evidence=old.evidence,
        T_cam_obj=torch.where(first, prediction.T_cam_obj.to(old.T_cam_obj.dtype), old.T_cam_obj),
        covariance=torch.where(first, prediction.covariance, old.covariance),
    )
