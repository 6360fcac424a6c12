"""States of objects that were seen well once, but not for a while."""

import torch
from states import changed

from torchtrack.core.lie import retract_about


def unseen(state, time_since_validated_s=0.2, **changes):
    """The state of an object that was seen well once, but not for a while."""
    return changed(state, time_since_validated_s=torch.full_like(state.health.time_since_validated_s, time_since_validated_s), **changes)


def uncertain(state, turn_rad=0.45):
    """Covariance of an object of which hardly anything is known."""
    return torch.eye(12, dtype=torch.float64).expand(len(state.motion.covariance), 12, 12) * turn_rad**2


def moved_away(tracker, state, metres):
    """Pose so much farther from the camera."""
    step = torch.zeros(len(state.T_cam_obj), 6, dtype=torch.float64)
    step[:, 5] = metres
    return retract_about(state.T_cam_obj, step, tracker.centre_obj.double())
