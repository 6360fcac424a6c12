"""Which creases, segments and print of a model the events show at all: learned online, for each object.

A CAD model has edges that no camera sees: rounded ones, grooves that were never milled, the facets of what is smooth in
reality, an older print. Where such an edge should fire, given its motion, and does not, or where events lie beside it
instead of on it, it is left out: it would draw the events of its neighbours to itself, and count as unexplained.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.config.tracker import ModelTrustConfig, TrackerConfig
from torchtrack.core.camera import project
from torchtrack.core.padded import take_points
from torchtrack.object_model.contour_source import ContourKind, ContourModel
from torchtrack.tracking.association.nearest import contour_table, match_nearest
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.association.weights import on_and_around
from torchtrack.tracking.contours.index import ContourIndex, index_contours
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import usual_index_radius
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.validation.measures import inside

# So many observations of its kind speak for an element before any of its own do; and of a kind, so many that are on it.
_PRIOR, _PRIOR_OF_KIND = 10.0, 200.0
# Windows at a start that tell nothing: the motion is not known yet, and a pose that is off makes true edges look false.
_STARTING = 4
# One window adds at most this share of what is remembered of an element: none decides alone.
_MOST_OF_MEMORY = 0.1
# What is left must explain this share of what all together explain.
_LEFT = 0.5
# A model lacks contours where this share of the events before it is farther than this from all of its own.
_UNEXPLAINED, _FAR_PX = 0.2, 3.0
# A contour that moved less across itself in a window need not have fired (px).
_LEAST_WAY_PX = 0.3


@dataclass(frozen=True)
class ModelTrust:
    """What was seen of each element of each object's model (see :mod:`torchtrack.object_model.contour_source`).

    Args:
        explained: observations on it.
        expected: observations near it, or those that its motion should have caused, whichever are more.
        taken_share: share of the object's moving contours that were not left out, when last looked at; 1 where the model lacks none.
        windows: windows taken so far.
    """

    explained: Float[Tensor, "b k"]
    expected: Float[Tensor, "b k"]
    taken_share: Float[Tensor, "b"]
    windows: int

    @classmethod
    def none(cls, groups: Int[Tensor, "b k"], like: Tensor) -> "ModelTrust":
        """Nothing seen yet."""
        nothing = torch.zeros_like(groups, dtype=like.dtype)
        return cls(nothing, nothing, torch.ones_like(nothing[:, 0]), 0)

    def of_width(self, count: int) -> "ModelTrust":
        """The same with places for ``count`` elements: how many there are depends on the objects that are tracked together."""
        missing = count - self.explained.shape[1]
        if missing == 0:
            return self
        return replace(self, explained=pad(self.explained, (0, missing)), expected=pad(self.expected, (0, missing)))

    def share(self, groups: Int[Tensor, "b k"]) -> Float[Tensor, "b k"]:
        """Of what should be seen of each element, the share that is; what little is known of it is taken from its kind."""
        both = torch.stack([self.explained, self.expected], 1)
        of_kind = both.new_zeros(len(both), 2, len(ContourKind) + 1).scatter_add_(2, groups[:, None].expand_as(both), both) + _PRIOR_OF_KIND
        of_kind = (of_kind[:, 0] / of_kind[:, 1]).gather(1, groups)
        return torch.addcmul(self.explained, of_kind, of_kind.new_full((1,), _PRIOR)) / (self.expected + _PRIOR)

    def shown(self, groups: Int[Tensor, "b k"], config: ModelTrustConfig) -> Bool[Tensor, "b k"]:
        """Which elements are to be trusted: all, where without the others too little would be left of what explains the events."""
        shown = (self.share(groups) >= config.least_share) | (groups == 0)
        enough = (self.explained * shown).sum(-1) >= _LEFT * self.explained.sum(-1)
        return shown | ~enough[:, None]

    def due(self, config: ModelTrustConfig) -> bool:
        """Whether this window is learned from: all of the first ones but those of the start, and then some."""
        return self.windows >= _STARTING and (self.windows < config.first_windows or self.windows % config.every == 0)


def element_groups(models: Sequence[ContourModel], batch: int) -> Int[Tensor, "b k"]:
    """The group of each element of each object's model; of what is the rest of the model, or padding, 0."""
    groups = torch.zeros(batch, max(len(model.element_group) for model in models), dtype=torch.int64)
    for model in models:
        groups[model.members, : len(model.element_group)] = model.element_group
    return groups


@torch.no_grad()
def judge_elements(
    trust: ModelTrust,
    fitted: Prediction,
    window_s: Float[Tensor, "b"],
    events: WindowEvents,
    learning: Bool[Tensor, "b"],
    config: TrackerConfig,
) -> ModelTrust:
    """What is known after a window: of each element, observations on it, near it, and as many as its motion should have caused.

    The last is by what the trusted contours of the object cause on their way.

    Args:
        fitted: the objects as they were found, with their motion.
        learning: which objects are learned from: their poses are to be trusted.
    """
    objects, shown = fitted.objects, fitted.objects.shown
    contours, element = objects.contours_of(torch.ones_like(trust.explained, dtype=torch.bool), fitted.T_cam_obj, config.contours)
    index = index_contours(contours, objects.image_size, usual_index_radius(config), config.matching.index_cell_px)
    way_px = (contours.normals * fitted.contour_velocity(contours)).sum(-1).abs() * window_s[:, None]
    way_px = way_px * (contours.mask & inside(contours.pixels, objects.image_size) & (way_px > _LEAST_WAY_PX))
    on, around = (_observed(fitted, contours, index, events, config) * (way_px > 0)[:, None]).unbind(1)
    taken = torch.ones_like(way_px) if shown is None else shown.gather(1, element)
    rate = (on * taken).sum(-1, keepdim=True) / (way_px * taken).sum(-1, keepdim=True).clamp(min=1)
    of_points = torch.stack([on, around, rate * way_px], 1)
    sums = of_points.new_zeros(len(on), 3, trust.explained.shape[1])
    on, around, caused = sums.scatter_add_(2, element[:, None].expand_as(of_points), of_points).unbind(1)
    trust = _remembered(trust, on, torch.maximum(around, caused), learning, config.model_trust.memory)
    share = torch.where(_lacks_contours(fitted, contours, index, events), ((way_px > 0) * taken).sum(-1) / (way_px > 0).sum(-1), 1)
    return replace(trust, taken_share=torch.where(learning & torch.isfinite(share), share, trust.taken_share))


def _lacks_contours(fitted: Prediction, contours: Contours, index: ContourIndex, events: WindowEvents) -> Bool[Tensor, "b"]:
    """Whether many events before an object are near no contour at all of its model."""
    objects = fitted.objects
    radius_px = 0.5 * objects.size_px(fitted.T_cam_obj)
    pixels = fitted.carried(events.pixels, events.age_s)
    x, y = (pixels - project(fitted.centre_cam[:, None], objects.intrinsics)).unbind(-1)
    before = events.mask & (x * x + y * y < radius_px[:, None].square())
    nearest = index.look_up(pixels)
    u, v = (pixels - take_points(index.pixels, nearest.clamp(min=0))).unbind(-1)
    learned = contours.kind.gather(1, nearest.clamp(min=0)) == int(ContourKind.LEARNED)
    far = (nearest < 0) | learned | (u * u + v * v > _FAR_PX**2)
    return (before & far).sum(-1) > _UNEXPLAINED * before.sum(-1)


def _remembered(trust: ModelTrust, explained: Tensor, expected: Tensor, learning: Tensor, memory: float) -> ModelTrust:
    """What is known with a window more: of old windows, as much is forgotten as does not fit."""
    new, old = torch.stack([explained, expected]), torch.stack([trust.explained, trust.expected])
    most = _MOST_OF_MEMORY * memory
    both = old + new * (most / expected.clamp(min=most))
    both = both * (memory / both[1].clamp(min=memory))
    explained, expected = torch.where(learning[:, None], both, old)
    # Rounding may leave a little more.
    return replace(trust, explained=explained, expected=expected.clamp(max=memory))


def _observed(fitted: Prediction, contours: Contours, index: ContourIndex, events: WindowEvents, config: TrackerConfig) -> Float[Tensor, "b 2 m"]:
    """How many observations lie on each contour point, and around it."""
    matching, moving = config.matching, fitted.moving(compensated=True)
    seen = select_events(events, index, fitted.moving(compensated=True), matching.max_events)
    place = fitted.carried(seen.pixels, seen.age_s)
    table, gate_px = contour_table(contours, index), max(matching.gates_px)
    # Once more from where the first contour's own motion carries it.
    for _ in range(2):
        matches, place = match_nearest(seen, table, place, moving, gate_px, matching)
    counts = on_and_around(matches.offsets, matches.near)
    sums = counts.new_zeros(len(counts), 2, contours.mask.shape[1])
    return sums.scatter_add_(2, matches.contour[:, None].expand_as(counts), counts)
