"""Pixels that contours pass in a window, point by point: :func:`torchtrack.tracking.association.claimed_events.claimed_pixels`."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.association import claimed_events
from torchtrack.tracking.association.claimed_events import CLAIMED_WITHIN_PX, PLACES
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.window_events import SharedEvents
from torchtrack.tracking.motion.prediction import Prediction


class PassingPoints(NamedTuple):
    """Contour points that move in the image: ``[b, m, 2]``, and which exist, ``[b, m]``."""

    pixels: Array
    velocity: Array
    exists: Array


class Claimants(NamedTuple):
    """Objects that may claim events: their windows (s), streams, and which are seen well, ``[b]``."""

    window_s: Array
    stream_index: Array
    is_seen_well: Array


# Without liberties of arithmetic: which pixel is the nearest may hang on the last digit.
@kernel()
def claim(points: PassingPoints, objects: Claimants, places: int, within_px: int, claimed: Array) -> None:
    """Mark the pixels around where contour points come by.

    Args:
        places: in a window that points are looked at in.
        claimed: ``[s, h, w]``, nothing so far; filled.
    """
    (pixels, velocity, exists), (window_s, stream_index, is_seen_well), (_, height, width) = points, objects, claimed.shape
    # Where a point came by already: neighbours along a contour share most of their pixels.
    been = np.zeros_like(claimed)
    for b in range(len(pixels)):
        if not is_seen_well[b]:
            continue
        of_stream, been_there = claimed[stream_index[b]], been[stream_index[b]]
        for place in range(places):
            back_s = window_s[b] * np.float32(place / (places - 1))
            for m in range(pixels.shape[1]):
                u, v = np.rint(pixels[b, m, 0] - back_s * velocity[b, m, 0]), np.rint(pixels[b, m, 1] - back_s * velocity[b, m, 1])
                # Written so that what is not a number is nowhere.
                if exists[b, m] and 0 <= u < width and 0 <= v < height and not been_there[int(v), int(u)]:
                    been_there[int(v), int(u)] = True
                    left, right = max(int(u) - within_px, 0), min(int(u) + within_px + 1, width)
                    for row in range(max(int(v) - within_px, 0), min(int(v) + within_px + 1, height)):
                        for column in range(left, right):
                            of_stream[row, column] = True


@kernel()
def strike(pixels: Array, claimed: Array, stream_index: Array, concerned: Array, own: Array, count: Array) -> None:
    """Strike events in claimed pixels from the lists of objects.

    Args:
        pixels: ``[e, 2]`` of all events.
        claimed: ``[s, h, w]``.
        own, count: ``[b, e]`` and ``[b]``, the lists, and how many events each has; changed.
    """
    _, height, width = claimed.shape
    for b in range(len(own)):
        if not concerned[b]:
            continue
        of_stream, left = claimed[stream_index[b]], 0
        for i in range(count[b]):
            event = own[b, i]
            u, v = np.rint(pixels[event, 0]), np.rint(pixels[event, 1])
            if not (0 <= u < width and 0 <= v < height and of_stream[int(v), int(u)]):
                own[b, left] = event
                left += 1
        count[b] = left


@accelerates(claimed_events.claimed_pixels)
def claimed_pixels_numba(
    prediction: Prediction, contours: Contours, is_seen_well: Bool[Tensor, "b"], window_s: Float[Tensor, "b"]
) -> Bool[Tensor, "s h w"]:
    """Point by point."""
    claimed = torch.zeros(prediction.objects.image_shape, dtype=torch.bool)
    points = as_arrays(contours.pixels, prediction.contour_velocity(contours), contours.mask)
    objects = as_arrays(window_s, prediction.objects.stream_index, is_seen_well)
    claim(points, objects, PLACES, CLAIMED_WITHIN_PX, claimed.numpy())
    return claimed


@accelerates(claimed_events.without_claimed, supports=lambda events, *_: isinstance(events, SharedEvents))
def without_claimed_numba(
    events: SharedEvents, claimed: Bool[Tensor, "s h w"], stream_index: Int[Tensor, "b"], concerned: Bool[Tensor, "b"]
) -> SharedEvents:
    """Event by event."""
    own, count = events.own.clone(), events.count.clone()
    strike(*as_arrays(events.shared.pixels[0], claimed, stream_index, concerned, own, count))
    return replace(events, own=own, count=count)
