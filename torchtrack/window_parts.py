"""Which windows are taken in parts: an object that has just been found may move by more than any gate in a whole one.

Its velocity is learned in short steps first, where there are events enough for them.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch
from torchtrack.core.events import EventBatch, stream_bounds
from torchtrack.kernels.arrays import as_arrays
from torchtrack.speed_limit import unknown_speed
from torchtrack.state import TrackerState
from torchtrack.tracking.contours.objects import ObjectBatch

# Fewer events than this do not make a part of a window.
_EVENTS_OF_A_PART = 400


def to_be_parted(state: TrackerState, events: EventBatch, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Objects whose window is taken in parts: of unknown motion, and with events enough for each part.

    Each object is asked for itself: its neighbours do not matter.

    Args:
        state: before the window.
        events: of the window.
        t_us: its end.
    """
    streams, fewest = objects.image_shape[0], config.window.parts * _EVENTS_OF_A_PART
    if len(events) < fewest:
        return torch.zeros_like(objects.stream_index, dtype=torch.bool)
    unknown = of_unknown_motion(state, t_us, objects, config)
    if streams == 1:
        return unknown
    return unknown & (torch.diff(stream_bounds(events, streams))[objects.stream_index] >= fewest)


def of_unknown_motion(state: TrackerState, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Objects of which a large part of their motion within a window is not known; none, where no window is to be taken in parts.

    Args:
        state: before the window.
        t_us: its end.
    """
    window = config.window
    if window.parts == 1 or not config.solver.prior:
        return torch.zeros_like(objects.stream_index, dtype=torch.bool)
    if dispatch.apply_to(state.covariance):
        return _of_unknown_motion_by_kernel(state, t_us, objects, config)
    window_s = ((t_us - state.t_us) * 1e-6)[objects.stream_index]
    unknown_m_s = unknown_speed(state.covariance, objects.diameter_m).to(objects.intrinsics.dtype)
    px_per_m = objects.px_per_m(state.T_cam_obj.to(unknown_m_s.dtype))
    sigma_m = state.covariance.diagonal(dim1=1, dim2=2)[:, 3:5].mean(1).sqrt().to(px_per_m.dtype)
    # What is not known to be anywhere is looked for by all events of a window, and with the motion that leads to each place.
    return (unknown_m_s * window_s * px_per_m > window.max_unknown_px) & (px_per_m * sigma_m <= config.search.wide_sigma_px)


def _of_unknown_motion_by_kernel(state: TrackerState, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """:func:`of_unknown_motion`, object by object."""
    # Not at the top: Numba is an extra.
    from torchtrack.kernels.filtering import find_unknown_motion

    is_unknown = torch.empty_like(objects.stream_index, dtype=torch.bool)
    own = as_arrays(objects.centre_obj, objects.intrinsics[:, 0], objects.diameter_m, objects.stream_index, t_us - state.t_us)
    limits = config.window.max_unknown_px, config.search.wide_sigma_px
    find_unknown_motion(*as_arrays(state.covariance, state.T_cam_obj), *own, *limits, is_unknown.numpy())
    return is_unknown
