"""What a weighting network sees of a window before it is aligned: all that tells whether an observation is of the contour near it."""

from dataclasses import dataclass, replace
from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import softsign

from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.core.padded import take_points
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.history import History
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction


@dataclass(frozen=True)
class WeightingInputs:
    """One window of every object, at the predicted pose; all constants, as far as gradients go.

    Args:
        observations: what is to be judged.
        seen: events of the window; all of them, where a weighting network of one's own is to judge.
        prediction: pose, motion and uncertainty of each object at the window's end.
        contours: visible contours there.
        index: which of them is nearest to a pixel.
        history: the time surface, also of the past before the window.
    """

    observations: Observations
    seen: ObjectEvents
    prediction: Prediction
    contours: Contours
    index: ContourIndex
    history: History

    @property
    def events(self) -> WindowEvents:
        """Events of the window, a row for each object."""
        return self.seen.rows()

    def age_s(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n"]:
        """Time since the newest event (s) at ideal pixels, rounded to whole ones; huge where there never was any."""
        return self.history.age_s(pixels)


def judged(inputs: WeightingInputs, weighting_network: nn.Module) -> Observations:
    """The observations, with how far a weighting network believes each of them.

    Raises:
        ValueError: if the weighting network gives something else than one number for each observation.
    """
    trust = weighting_network(inputs)
    expected = inputs.observations.age_s.shape
    if trust.shape != expected:
        raise ValueError(f"a weighting network must give one number for each observation, shape {list(expected)}; got {list(trust.shape)}.")
    return replace(inputs.observations, trust=trust.to(inputs.observations.age_s.dtype))


# Where the patch is sampled: across the contour and along it (px). Negative is behind the moving edge.
ACROSS_PX, ALONG_PX = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0), (-2.0, 0.0, 2.0)


# What is older than this, in px of the edge's motion, says no more.
OLDEST_PX = 6.0


# Slower than this (px/s), an edge has no direction that it moves to. Speeds are told in this unit, by their logarithm.
SLOW_PX_S, SPEED_UNIT_PX_S = 10.0, 100.0


# Events are counted by pixel, a power of two of them a side: what is that far apart shares a place, and hardly ever fires at once.
SIDE = 256


# A place beyond this is nowhere (px).
_FARTHEST_PX = 1e6


# Kinds of contours that a model has.
_KINDS = int(ContourKind.SPLAT) + 1


_COUNTS, _SINGLE = 2 * len(ACROSS_PX) * len(ALONG_PX), 6


OF_KIND = _COUNTS + len(ACROSS_PX)


FEATURES = OF_KIND + _KINDS + _SINGLE


"""How many numbers describe an observation."""


@dataclass(frozen=True)
class _Frame:
    """The contour nearest to each observation, and the observation moved to the window's end with it.

    Args:
        exists: where there is one; ``kind`` of it.
        normal: turned to where the contour moves; ``outward`` is -1 where that turned it round.
        speed_px_s: of the contour along its normal.
        moved: the observation at the window's end.
    """

    exists: Tensor
    kind: Tensor
    normal: Tensor
    outward: Tensor
    speed_px_s: Tensor
    moved: Tensor

    def around(self, centre: Float[Tensor, "b n 2"], along_px: tuple[float, ...]) -> tuple[Float[Tensor, "b n p"], Float[Tensor, "b n p"]]:
        """Columns and rows of the places of a patch around each centre."""
        across, along = constant(tuple(product(ACROSS_PX, along_px)), centre.dtype, centre.device).T
        (u, v), (nu, nv) = centre[..., None].unbind(-2), self.normal[..., None].unbind(-2)
        return u + across * nu - along * nv, v + across * nv + along * nu


def trust_features(inputs: WeightingInputs) -> Float[Tensor, "b n f"]:
    """What describes each observation: numbers of about unit size."""
    observations, frame = inputs.observations, _frame(inputs)
    polarity = observations.polarity
    # Contours that were learned are texture.
    kind = torch.where(frame.kind == int(ContourKind.LEARNED), int(ContourKind.TEXTURE), frame.kind)
    # Not by one_hot, which reads values back to check them.
    kinds = (kind[..., None] == torch.arange(_KINDS, device=kind.device)).to(polarity.dtype)
    single = [
        (frame.speed_px_s / SPEED_UNIT_PX_S).log1p(),
        polarity,
        polarity * frame.outward,
        polarity.abs(),
        _age_share(observations),
        frame.exists.to(polarity.dtype),
    ]
    return torch.cat([_counts(inputs, frame), _ages(inputs, frame), kinds, torch.stack(single, -1)], -1)


@accelerable
def silhouette_features(inputs: WeightingInputs) -> tuple[Float[Tensor, "r n f"], Bool[Tensor, "b n"], Int[Tensor, "r"]]:
    """:func:`trust_features`, which observations are nearest to the smooth silhouette, and of which objects there may be any.

    Of other observations and other objects they need not be told.
    """
    features = trust_features(inputs)
    of_silhouette = features[..., OF_KIND + int(ContourKind.SMOOTH)] * features[..., -1] > 0
    return features, of_silhouette & inputs.observations.mask, torch.arange(len(features), device=features.device)


def _frame(inputs: WeightingInputs) -> _Frame:
    """Nearest contours, as the predicted motion says."""
    observations, contours, prediction = inputs.observations, inputs.contours, inputs.prediction
    plane = prediction.plane_velocity(observations.pixels)
    nearest_index = inputs.index.look_up(torch.addcmul(observations.pixels, plane, observations.age_s[..., None]))
    table = torch.cat([contours.normals, prediction.contour_velocity(contours), contours.kind[..., None].to(plane.dtype)], -1)
    normals, velocity, kind = take_points(table, nearest_index.clamp(min=0)).split([2, 2, 1], -1)
    speed = (normals * velocity).sum(-1)
    outward = torch.where(speed < 0, -1.0, 1.0).to(speed.dtype)
    moved = torch.addcmul(observations.pixels, velocity, observations.age_s[..., None])
    return _Frame(nearest_index >= 0, kind[..., 0].long(), outward[..., None] * normals, outward, speed.abs().clamp(min=SLOW_PX_S), moved)


def _age_share(observations: Observations) -> Float[Tensor, "b n"]:
    """How old each observation is, of the oldest of the object."""
    oldest_s = (observations.age_s * observations.mask).amax(-1, keepdim=True)
    return observations.age_s / oldest_s.clamp(min=1e-6)


def _ages(inputs: WeightingInputs, frame: _Frame) -> Float[Tensor, "b n p"]:
    """How much older than the observation the time surface is across the contour, in px of the edge's motion."""
    observations = inputs.observations
    places = torch.stack(frame.around(observations.pixels, (0.0,)), -1)
    newest_s = inputs.age_s(places.flatten(1, 2)).view(places.shape[:3])
    behind_px = (newest_s - observations.age_s[..., None]) * frame.speed_px_s[..., None]
    return behind_px.clamp(-OLDEST_PX, OLDEST_PX) / OLDEST_PX


def _counts(inputs: WeightingInputs, frame: _Frame) -> Float[Tensor, "b n p"]:
    """Events of the observation's own polarity and of the other, around it, all moved to the window's end with the object."""
    events = inputs.events
    moved = inputs.prediction.carried(events.pixels, events.age_s)
    cell = 2 * _cells(moved[..., 0], moved[..., 1]) + (events.polarity > 0)
    counts = torch.zeros(len(cell), 2 * SIDE**2, dtype=moved.dtype, device=moved.device)
    counts = counts.scatter_add(1, cell, events.mask.to(moved.dtype))
    places = 2 * _cells(*frame.around(frame.moved, ALONG_PX))
    own = places + (inputs.observations.polarity >= 0)[..., None]
    of_both = torch.cat([own, 2 * places + 1 - own], -1)
    return softsign(counts.gather(1, of_both.flatten(1)).view(of_both.shape))


def _cells(u: Float[Tensor, "*b"], v: Float[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """The place that each pixel is counted at."""
    column, row = (value.round().nan_to_num(0.0).clamp(-_FARTHEST_PX, _FARTHEST_PX).long() & (SIDE - 1) for value in (u, v))
    return torch.add(column, row, alpha=SIDE)
