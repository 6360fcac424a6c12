"""Learning contours on the surface of objects: events that no contour explains, and the lines that they gather on.

Such events are carried to the surface that the pose shows at their place, as drafts. Where drafts of several windows
gather on a line, a contour point is learned. It counts once later windows have confirmed it, and is forgotten when it
should fire and does not: what moves before the object, and the shading that wanders over it, does not stay on the surface.
"""

from dataclasses import dataclass, replace
from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchtrack.config.tracker import AdaptationConfig, TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.camera import project
from torchtrack.core.constants import constant
from torchtrack.core.image_velocity import object_plane_velocity, pixel_velocity
from torchtrack.core.lie import transform_points
from torchtrack.core.padded import take_points
from torchtrack.tracking.adaptation.cell_grid import CellGrid, Lines, cell_of, fit_lines, is_near, point_sums, tallied
from torchtrack.tracking.adaptation.learned_contours import TRUSTED_FROM, LearnedContours, judge_model
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.contours.points import Contours, assemble, joined
from torchtrack.tracking.contours.surface_rays import surface_points
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.validation.scored_fit import ScoredFit

# Events that are learned from in a window, per object: it bounds time. Not measured.
_EVENTS = 1000
# Older events are left out where the object has since moved by more than this (px).
_LONGEST_WAY_PX = 4.0
# A contour this near explains an event, and two learned points are no nearer (cells).
_EXPLAINED_CELLS, _APART_CELLS = 2, 2.0
# A line is made of drafts within this distance, at least this many, no thicker than this, and longer than thick (cells²).
_LINE_CELLS, _FEWEST_DRAFTS, _THICKEST, _THICK_TO_LONG = 3, 4.0, 0.4, 0.3
# Drafts that lines are looked for at, in one window.
_CANDIDATES = 200
# A learned point is looked for this far along its line, on it and beside it (cells).
_ALONG_CELLS, _ON_CELLS, _BESIDE_CELLS = (-2.0, -1.0, 0.0, 1.0, 2.0), (-0.5, 0.5), (-2.0, 2.0)
# It is confirmed by this many times more events on the line than beside it; evidence lost where nothing fired; the most of it.
_ON_TO_BESIDE, _SILENT, _MOST_EVIDENCE = 1.5, 0.25, 10.0
# Evidence that drafts give, by their number, and the most that they give.
_EVIDENCE_PER_DRAFT = 0.25
# A contour that moved less across itself need not have fired (px).
_LEAST_WAY_PX = 0.5
# Objects whose centres are farther apart in the image than so many of their diameters, and so many pixels, neither hide one another nor share
# events. One that is nearer to the camera than so many diameters may be anywhere in the image.
_REACH, _BESIDE_PX, _CLOSE = 0.75, 16.0, 2.0
# A surface seen at a more grazing angle shows nothing of use (cosine).
_GRAZING_COSINE = 0.2


@dataclass(frozen=True)
class Surroundings:
    """The objects at the end of a window.

    Args:
        objects: the objects, with what they had learned.
        T_cam_obj: their poses.
        velocity: rotation and velocity of the centre (rad/s, m/s).
        window_s: duration of each object's window.
        contours: visible contours, with the learned ones that count.
        learning: which objects may learn: their poses are to be trusted.
    """

    objects: ObjectBatch
    T_cam_obj: Float[Tensor, "b 4 4"]
    velocity: Float[Tensor, "b 6"]
    window_s: Float[Tensor, "b"]
    contours: Contours
    learning: Bool[Tensor, "b"]

    def rows(self, chosen: Int[Tensor, "k"]) -> "Surroundings":
        """Some of the objects."""
        own = self.T_cam_obj[chosen], self.velocity[chosen], self.window_s[chosen]
        return Surroundings(self.objects.rows(chosen), *own, self.contours.rows(chosen), self.learning[chosen])

    @property
    def centre_cam(self) -> Float[Tensor, "b 3"]:
        """Centre of each object in the camera's frame (m)."""
        return transform_points(self.T_cam_obj, self.objects.centre_obj[:, None])[:, 0]

    def contour_velocity(self, contours: Contours) -> Float[Tensor, "b m 2"]:
        """Image velocity of contours (px/s)."""
        return pixel_velocity(contours.points_cam, self.velocity, self.centre_cam, self.objects.intrinsics)

    def to_object(self, vectors_cam: Tensor) -> Tensor:
        """Directions in the camera's frame, in the object's."""
        return vectors_cam @ self.T_cam_obj[:, :3, :3]


@dataclass(frozen=True)
class _Sample:
    """Some events of each object: where they were seen, and where their place is at the window's end, in pixels and cells."""

    seen_px: Tensor
    age_s: Tensor
    pixels: Tensor
    places: Tensor
    mask: Tensor


@torch.no_grad()
def learn_after(
    learned: LearnedContours,
    around: Surroundings,
    scored: ScoredFit,
    events: ObjectEvents,
    wanted: Bool[Tensor, "b"] | None,
    config: TrackerConfig,
) -> LearnedContours:
    """What is known after a window of contours that the models lack.

    Args:
        wanted: objects to learn of, from the state before the window; none where the window is not due.
    """
    velocity, image_sizes, any_count = around.contour_velocity, around.objects.image_sizes, around.objects.learned is not None
    learned = judge_model(learned, scored, velocity, image_sizes, config, any_count=any_count)
    if wanted is None or host_sync.none_of(wanted):
        return learned
    if not host_sync.read_at_once(wanted):
        return learned.but_of(wanted, learn(learned, around, events.rows(), config))
    # As a rule, there are few such objects, and of what is lost nothing is learned.
    wanted = wanted & around.learning
    if host_sync.none_of(wanted):
        return learned
    concerned = _concerned(wanted, around).nonzero()[:, 0]
    known = learn(learned.rows(concerned), around.rows(concerned), events.of_objects(concerned), config)
    return learned.with_rows(concerned[wanted[concerned]], known.rows(wanted[concerned]))


def _concerned(wanted: Bool[Tensor, "b"], around: Surroundings) -> Bool[Tensor, "b"]:
    """Objects to learn of, those beside them in the image, and those beside these: whether one hides another hangs on what is beside it."""
    objects, centre_cam = around.objects, around.centre_cam
    if not objects.shared:
        return wanted
    pixels, reach_px = project(centre_cam[:, None], objects.intrinsics), _REACH * objects.size_px(around.T_cam_obj)
    is_close = centre_cam[:, 2] < _CLOSE * objects.diameter_m
    is_next = (pixels - pixels.transpose(0, 1)).norm(dim=-1) < reach_px[:, None] + reach_px + _BESIDE_PX
    is_next = (is_next | is_close[:, None] | is_close) & (objects.stream_index[:, None] == objects.stream_index)
    return wanted | (is_next & (wanted | (is_next & wanted).any(1))).any(1)


def learn(learned: LearnedContours, around: Surroundings, events: WindowEvents, config: TrackerConfig) -> LearnedContours:
    """What is known after a window: confirmed or doubted, and added to."""
    centre_px = project(around.centre_cam[:, None], around.objects.intrinsics)
    grid = CellGrid.around(centre_px, around.objects.size_px(around.T_cam_obj))
    sample = _sample(around, grid, events, _EVENTS)
    known = learned.points(least=1e-6).contours(around.T_cam_obj, around.objects.intrinsics)
    known = around.objects.visible(known, around.T_cam_obj, config.contours)
    learned = replace(learned, evidence=_weighed(learned.evidence, known, around, grid, sample))
    explained = joined(around.contours, known)
    taken = tallied(grid.place(explained.pixels), explained.mask[:, None].to(sample.places.dtype))[:, 0]
    learned, added = _with_drafts(learned, around, sample, sample.mask & ~is_near(taken, sample.places, _EXPLAINED_CELLS), config)
    return _with_lines(learned, around, grid, taken, added, config.adaptation)


def _sample(around: Surroundings, grid: CellGrid, events: WindowEvents, count: int) -> _Sample:
    """Events before each object that learns, spread evenly in time, and young enough to be carried to the window's end."""
    intrinsics, radius_px = around.objects.intrinsics, 0.5 * around.objects.size_px(around.T_cam_obj)
    drift = object_plane_velocity(grid.middle, around.velocity, around.centre_cam, intrinsics).norm(dim=-1)[:, 0]
    speed_px_s = drift + around.velocity[:, :3].norm(dim=-1) * radius_px
    x, y = (events.pixels - grid.middle).unbind(-1)
    near = events.mask & around.learning[:, None] & (x * x + y * y < radius_px[:, None].square())
    near = near & (events.age_s * speed_px_s[:, None] < _LONGEST_WAY_PX)
    chosen, exists = events.draw(near, count / near.sum(-1, keepdim=True).clamp(min=count), count)
    values = take_points(torch.cat([events.pixels, events.age_s[..., None]], -1), chosen)
    seen_px, age_s = values[..., :2], values[..., 2:]
    pixels = seen_px + object_plane_velocity(seen_px, around.velocity, around.centre_cam, intrinsics) * age_s
    return _Sample(seen_px, age_s, pixels, grid.place(pixels), exists)


def _weighed(evidence: Tensor, known: Contours, around: Surroundings, grid: CellGrid, sample: _Sample) -> Tensor:
    """Evidence after a window: more where events lie on a learned line, less where they lie beside it or nothing fired."""
    events = tallied(sample.places, sample.mask[:, None].to(evidence.dtype))[:, 0]
    place = grid.place(known.pixels)

    def count(sides: tuple[float, float]) -> Tensor:
        looked_at = constant(tuple(product(_ALONG_CELLS, sides)), evidence.dtype, evidence.device)
        along, side = (value[:, None] for value in looked_at.unbind(-1))
        normal_x, normal_y = (value[:, None] for value in known.normals.unbind(-1))
        x = place[:, None, :, 0] + along * normal_y + side * normal_x
        y = place[:, None, :, 1] - along * normal_x + side * normal_y
        return events.gather(1, cell_of(x, y).flatten(1)).view(x.shape).sum(1)

    on, around_count = count(_ON_CELLS), count(_BESIDE_CELLS)
    way_px = (known.normals * around.contour_velocity(known)).sum(-1).abs() * around.window_s[:, None]
    silent = torch.where(way_px > _LEAST_WAY_PX, -_SILENT, 0.0)
    change = torch.where(on + around_count == 0, silent, torch.where(on > _ON_TO_BESIDE * around_count, 1.0, -1.0))
    return torch.where(known.mask & around.learning[:, None], (evidence + change).clamp(0, _MOST_EVIDENCE), evidence)


def _with_drafts(
    learned: LearnedContours, around: Surroundings, sample: _Sample, fresh: Tensor, config: TrackerConfig
) -> tuple[LearnedContours, Tensor]:
    """Unexplained events, carried to the surface with its own motion, in the place of the oldest drafts; and how many they are."""
    objects = around.objects
    met = surface_points(objects.models, around.T_cam_obj, sample.pixels, objects.intrinsics)
    velocity = pixel_velocity(met.points_cam, around.velocity, around.centre_cam, objects.intrinsics)
    points_cam = met.shifted_to(sample.seen_px + velocity * sample.age_s, objects.intrinsics)
    points_obj = around.to_object(points_cam - around.T_cam_obj[:, None, :3, 3])
    fresh = fresh & met.mask & torch.isfinite(points_obj).all(-1)
    if objects.shared:
        # What moves before the object is not on it. Any tangents will do for this.
        kind = torch.zeros_like(fresh, dtype=torch.int64)
        on_it = assemble(points_obj, torch.ones_like(points_obj), kind, fresh, around.T_cam_obj, objects.intrinsics)
        fresh = objects.visible(on_it, around.T_cam_obj, config.contours).mask
    slots = learned.drafts_obj.shape[1]
    slot = torch.where(fresh, (learned.drafted[:, None] + fresh.cumsum(-1) - 1) % slots, slots)
    added = fresh.sum(-1)
    return replace(learned, drafts_obj=_put(learned.drafts_obj, slot, points_obj), drafted=learned.drafted + added), added


def _put(values: Tensor, slot: Tensor, new: Tensor) -> Tensor:
    """``values`` with new ones in some slots; the slot after the last is for those that have none."""
    spare = torch.cat([values, values[:, :1]], 1)
    return spare.scatter(1, slot.view(*slot.shape, *[1] * (new.dim() - 2)).expand_as(new), new)[:, : values.shape[1]]


def _with_lines(
    learned: LearnedContours, around: Surroundings, grid: CellGrid, taken: Tensor, added: Tensor, config: AdaptationConfig
) -> LearnedContours:
    """New contour points where drafts gather on a line that no contour has, in the place of those without evidence."""
    drafts_px = project(transform_points(around.T_cam_obj, learned.drafts_obj), around.objects.intrinsics)
    drafts, slots = grid.place(drafts_px), drafts_px.shape[1]
    sums = point_sums(drafts, torch.arange(slots, device=drafts.device) < learned.drafted[:, None])
    step = (added / _CANDIDATES).clamp(min=1)[:, None]
    newest = learned.drafted[:, None] - 1 - (torch.arange(_CANDIDATES, device=drafts.device) * step).long()
    lines = fit_lines(sums, take_points(drafts, newest % slots), _LINE_CELLS)
    wanted = (newest >= 0) & (added > 0)[:, None] & _is_thin(lines)
    lines = fit_lines(sums, lines.places, _LINE_CELLS)
    wanted = wanted & _is_thin(lines) & ~is_near(taken, lines.places, _EXPLAINED_CELLS)
    points_obj, tangents_obj, on_surface = _carried(lines, around, grid)
    wanted = _apart(lines.places, wanted & on_surface)
    least, emptiest = learned.evidence.topk(min(_CANDIDATES, config.learned_points), largest=False)
    rank = wanted.cumsum(-1) - 1
    fits = wanted & (rank < least.shape[1])
    rank = rank.clamp(0, least.shape[1] - 1)
    slot = torch.where(fits & (least.gather(1, rank) <= 0), emptiest.gather(1, rank), config.learned_points)
    evidence = (_EVIDENCE_PER_DRAFT * lines.count).clamp(1.0, TRUSTED_FROM)
    return replace(
        learned,
        points_obj=_put(learned.points_obj, slot, points_obj),
        tangents_obj=_put(learned.tangents_obj, slot, tangents_obj),
        evidence=_put(learned.evidence, slot, evidence),
    )


def _is_thin(lines: Lines) -> Tensor:
    """Which lines are lines, and no heap of points."""
    return (lines.count >= _FEWEST_DRAFTS) & (lines.thickness < _THICKEST) & (lines.thickness < _THICK_TO_LONG * lines.length)


def _apart(places: Tensor, mask: Tensor) -> Tensor:
    """Those that have no earlier one near."""
    # By coordinate: sums along a last axis of two are slow.
    x, y = (value[:, :, None] - value[:, None] for value in places.unbind(-1))
    near = torch.addcmul(x * x, y, y) < _APART_CELLS**2
    return mask & ~(near & mask[:, None]).tril(-1).any(-1)


def _carried(lines: Lines, around: Surroundings, grid: CellGrid) -> tuple[Tensor, Tensor, Tensor]:
    """Points and tangents (object frame) on the surface where lines are seen, and which of them exist."""
    objects = around.objects
    pixels = grid.pixels(lines.places)
    met = surface_points(objects.models, around.T_cam_obj, pixels, objects.intrinsics)
    cosine = (met.normals_cam * normalize(met.points_cam, dim=-1)).sum(-1).abs()
    ahead_cam = met.shifted_to(pixels + lines.directions, objects.intrinsics)
    tangents_obj = normalize(around.to_object(ahead_cam - met.points_cam), dim=-1)
    points_obj = around.to_object(met.points_cam - around.T_cam_obj[:, None, :3, 3])
    return points_obj, tangents_obj, met.mask & (cosine > _GRAZING_COSINE)
