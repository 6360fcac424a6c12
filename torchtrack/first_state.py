"""The state of a tracker before its first window: poses, and nothing learned yet."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.model_trust import ModelTrust
from torchtrack.state import Probation, TrackerState
from torchtrack.tracked_objects import TrackedObjects
from torchtrack.tracking.adaptation.learned_contours import LearnedContours
from torchtrack.tracking.adaptation.pixel_latency import unknown_circuits
from torchtrack.tracking.association.polarity import nothing_remembered
from torchtrack.tracking.frontend.bursts import no_bursts
from torchtrack.tracking.frontend.time_surface import empty_last_event
from torchtrack.tracking.motion.model import initial_covariance


def first_state(tracked: TrackedObjects, T_cam_obj: Float[Tensor, "b 4 4"], t_us: Int[Tensor, "s"]) -> TrackerState:
    """The state at ``t_us``, with the objects at these poses (float64) and at rest, as far as is known."""
    config = tracked.config
    at_rest = torch.zeros(len(T_cam_obj), 6, dtype=tracked.intrinsics.dtype, device=T_cam_obj.device)
    nothing, covariance = torch.zeros_like(tracked.diameter_m), initial_covariance(tracked.diameter_m, config.motion)
    last_event_us, burst_age_us = (empty(tracked.streams, *tracked.image_size, T_cam_obj.device) for empty in (empty_last_event, no_bursts))
    learns = config.learning.points and config.contours.source == "mesh"
    learned = LearnedContours.none(len(at_rest), config.learning, at_rest) if learns else None
    trust = ModelTrust.none(tracked.element_groups, at_rest) if tracked.judges else None
    return TrackerState(
        T_cam_obj.clone(),
        *(at_rest, at_rest, covariance),
        *(nothing,) * 7,
        *(T_cam_obj.clone(), nothing, nothing_remembered(at_rest), unknown_circuits(nothing)),
        *(t_us, last_event_us, burst_age_us),
        Probation.none(T_cam_obj, covariance),
        learned,
        trust,
    )
