"""How long windows last in mode 'adaptive': the faster an object moves in the image, the shorter.

Contours that move far within a window are carried far to its end, with a motion that is not quite constant; those that
hardly move tell little, at the full price of a step. So a window is as long as the contours of the fastest object of
its stream take to move on by a set number of pixels.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.config.tracker import WindowConfig
from torchtrack.tracking.contours.points import reproject
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.status import Status

# Contours slower than this (px/s) would take longer than any window.
_STILL_PX_S = 1e-3


class WindowLength:
    """How long the next window of one stream is to last: whoever tracks it says so, whoever cuts it asks.

    Args:
        config: how the stream is cut; the first window is of its ``duration_us``.

    Attributes:
        us: length of the next window (µs).
    """

    def __init__(self, config: WindowConfig) -> None:
        self.config = config
        self.us = config.duration_us

    def __call__(self) -> int:
        """Length of the next window (µs)."""
        return self.us


def tell_lengths(lengths: Sequence[WindowLength], tracker: Tracker, before: TrackerState, result: StepResult) -> None:
    """Say how long the next window of each stream is to last, after a window of all of them; nothing in the other modes.

    Args:
        lengths: one per stream.
        tracker: of all streams.
        before: state before the window.
        result: of it.
    """
    if any(length.config.mode == "adaptive" for length in lengths):
        for length, us in zip(lengths, next_window_us(tracker, before, result, lengths[0].config).tolist(), strict=True):
            length.us = us


def next_window_us(tracker: Tracker, before: TrackerState, result: StepResult, config: WindowConfig) -> Int[Tensor, "s"]:
    """Time that the fastest object of each stream takes to move by ``config.motion_px``, within bounds (µs).

    An object that was not followed is given ``config.duration_us``: its motion is not known.
    """
    speed_px_s = contour_speed(tracker, before, result)
    us = (1e6 * config.motion_px / speed_px_s.clamp(min=_STILL_PX_S)).clamp(config.shortest_us, config.longest_us).long()
    us = torch.where(result.status <= int(Status.UNCERTAIN), us, config.duration_us)
    longest = torch.full_like(result.t_us, config.longest_us)
    return longest.scatter_reduce(0, tracker.stream_index, us, "amin")


def contour_speed(tracker: Tracker, before: TrackerState, result: StepResult) -> Float[Tensor, "b"]:
    """How fast the visible contours of each object moved in the window, in the mean over them (px/s): as they will in the next."""
    contours = result.contours
    T_before = before.T_cam_obj.to(contours.pixels.dtype)
    way_px = (contours.pixels - reproject(contours, T_before, tracker.intrinsics).pixels).norm(dim=-1)
    mean_px = (way_px * contours.mask).sum(-1) / contours.mask.sum(-1).clamp(min=1)
    window_us = (result.t_us - before.t_us)[tracker.stream_index]
    return 1e6 * mean_px / window_us.clamp(min=1)
