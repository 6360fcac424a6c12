"""Pixel latency: how slow the pixels of a sensor are, measured by how late in their bursts the events on contours come.

In good light a pixel fires while an edge passes it, which is over once the edge has moved on by its blur; in poor light it fires
on while the edge moves on by several pixels more. To date late events back is right of slow pixels alone: of fast ones they are
as much of the edge as early ones are, and without them it seems to lie before where it is. The latency depends on the sensor and
on the light: it is remembered.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.config.tracker import AssociationConfig
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.association.weights import on_and_around
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction

# An event is late once its edge has moved on by this much since the first of its burst (px). Of an edge that hardly comes farther
# while a burst lasts, nothing is told.
_LATE_PX, _FAR_ENOUGH_PX = 2.0, 2.5
# Shares of events that are late up to which pixels are fast, and from which they are slow: measured, 0.01 to 0.1, and 0.1 to 0.35.
_FAST, _SLOW = 0.07, 0.12
# What was not seen well for so long (s) is dated back in full.
_NOT_VALIDATED_S = 0.02
# It changes with the light, and is looked at so often (µs). Events that are remembered: those of some five such windows.
LOOK_US, _REMEMBERED = 20_000, 5_000.0


def unknown_latency(like: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """Share of late events before any were seen: as of slow pixels, whose late events do more harm."""
    return torch.full_like(like, _SLOW)


def slowness(late_share: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """From 0, of pixels that are fast, to 1, of slow ones."""
    return ((late_share - _FAST) / (_SLOW - _FAST)).clamp(0, 1)


def dated(
    observations: Observations, late_share: Float[Tensor, "b"], time_since_validated_s: Float[Tensor, "b"], config: AssociationConfig
) -> Observations:
    """The observations as late in their bursts as counts: less so, and then not dated back so far, the faster pixels are.

    Of what is not seen well all are dated back: less exact, but events of what moves otherwise gather less.

    Args:
        time_since_validated_s: how long ago each object was seen well (s).
    """
    if not _tells(config):
        return observations
    counts = torch.maximum(slowness(late_share), (time_since_validated_s / _NOT_VALIDATED_S).clamp(max=1))
    return replace(observations, into_burst_s=observations.into_burst_s * counts[:, None])


@torch.no_grad()
def late_share_after(
    late_share: Float[Tensor, "b"],
    observations: Observations,
    contours: Contours,
    matches: Matches,
    prediction: Prediction,
    known: Bool[Tensor, "b"],
    config: AssociationConfig,
) -> Float[Tensor, "b"]:
    """Share of the events on moving contours that are late, with a window more.

    Args:
        late_share: before the window.
        observations: as they were, before :func:`dated`.
        contours: that were matched, at the predicted pose and moving with it.
        known: objects whose pose is sure: of the others nothing is told.
    """
    if not _tells(config):
        return late_share
    speed_px_s = vecdot(contours.normals, prediction.contour_velocity(contours)).abs().gather(1, matches.contour)
    around = (on_and_around(matches.offsets, matches.near)[:, 1] > 0) & (observations.polarity != 0)
    tells = around & known[:, None] & (speed_px_s > _FAR_ENOUGH_PX / (1e-6 * config.burst_us))
    is_late = tells & (observations.into_burst_s * speed_px_s > _LATE_PX)
    late, count = (which.sum(1, dtype=late_share.dtype) for which in (is_late, tells))
    return torch.lerp(late_share, late / count.clamp(min=1), count / (count + _REMEMBERED))


def _tells(config: AssociationConfig) -> bool:
    """Whether there is anything to tell."""
    return config.pixel_latency and config.burst_us > 0 and config.max_events > 0
