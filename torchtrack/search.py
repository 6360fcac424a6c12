"""Many poses tried at once, where one prediction is too uncertain: after an occlusion, or when a pose begins to slip.

Thousands of poses are drawn from the prediction's covariance and marked by how many more events lie on their contours
than beside them; the most promising are aligned as one batch, and the one that explains most is taken.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack import quality, readback
from torchtrack.alignment import Fit, align, index_for
from torchtrack.camera import project
from torchtrack.config.tracker import SearchConfig, TrackerConfig
from torchtrack.constants import constant
from torchtrack.contours import Contours
from torchtrack.lie import retract_about, transform_points
from torchtrack.observations import WindowEvents, select_events
from torchtrack.pose_solver import Linearisation
from torchtrack.prediction import Prediction
from torchtrack.readback import Answer

# Events beside a contour are counted this far from it (px), and more than this many of them in one place say no more.
_BESIDE_PX, _ENOUGH_EVENTS = 4.0, 3.0
# Contour points that a drawn pose is marked by, at most.
_MARKED_POINTS = 200
# Pixels around the image that events and contours may lie in.
_BORDER_PX = 2


@dataclass(frozen=True)
class Found:
    """What one window gave for each object.

    Args:
        fit: poses, and what they stand on.
        measured: share of the moving contour that events explain; not a number where hardly anything moves.
        count: matched observations.
    """

    fit: Fit
    measured: Float[Tensor, "b"]
    count: Int[Tensor, "b"]

    @cached_property
    def share(self) -> Float[Tensor, "b"]:
        """Share of the moving contour that events explain; where hardly anything moves, nothing speaks against the pose."""
        return self.measured.nan_to_num(1.0)


def judge_fit(prediction: Prediction, fit: Fit, config: TrackerConfig) -> Found:
    """A fit with its quality; without enough observations it explains nothing."""
    velocity = prediction.contour_velocity(fit.contours)
    measured = quality.measured_share(fit.contours, fit.matches, velocity, prediction.objects.image_size, config.quality)
    return Found(fit, measured, fit.matches.mask.sum(-1))


@dataclass(frozen=True)
class Doubt:
    """What speaks for trying other poses, before a window is aligned.

    Args:
        sigma_px: standard deviation of each object's prediction in the image.
        last_share: explained in the window before: one bad window alone is no reason.
        usual_share: explained as a rule.
        starting: objects whose motion is not known yet.
    """

    sigma_px: Float[Tensor, "b"]
    last_share: Float[Tensor, "b"]
    usual_share: Float[Tensor, "b"]
    starting: Bool[Tensor, "b"]

    def asks(self, share: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects are to be searched for: uncertain ones, and those whose explained share stays below the usual."""
        starting = self.starting if config.at_start else torch.zeros_like(self.starting)
        return starting | (self.sigma_px > config.from_sigma_px) | (share < config.dropped_to * self.usual_share)


def may_be_wanted(doubt: Doubt, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects :func:`search_wanted` can turn out to search for, as far as is known before the window is aligned."""
    if config.search.hypotheses == 0 or not config.solver.prior:
        return torch.zeros_like(doubt.starting)
    return doubt.asks(doubt.last_share, config.search)


def search_wanted(prediction: Prediction, doubt: Doubt, events: WindowEvents, found: Found, config: TrackerConfig) -> Found:
    """Try other poses for the objects that need it, one object after the other."""
    if config.search.hypotheses == 0 or not config.solver.prior:
        return found
    # Without events no pose is better than another.
    enough = events.mask.sum(-1) >= config.quality.min_observations
    tried = enough & doubt.asks(torch.maximum(found.share, doubt.last_share), config.search)
    margin = torch.where(doubt.starting, config.search.start_margin, config.search.margin)
    answers = Answer.to(tried), Answer.to(doubt.sigma_px)
    for number, (is_tried, own_sigma_px) in enumerate(zip(*(answer.numbers() for answer in answers), strict=True)):
        if is_tried:
            found = search(number, prediction, own_sigma_px, margin[number], events, found, config)
    return found


def search(
    number: int, prediction: Prediction, sigma_px: float, margin: Float[Tensor, ""], events: WindowEvents, found: Found, config: TrackerConfig
) -> Found:
    """Try other poses for the object ``number``; ``found`` with the best of them in its place, if that is better.

    Args:
        sigma_px: standard deviation of the object's prediction in the image.
        margin: by how much another pose must explain more.
        events: of all objects.
    """
    settings, count = config.search, config.search.hypotheses
    widen = max(settings.least_sigma_px / max(sigma_px, 1e-6), 1.0)
    offsets = draw_offsets(prediction.covariance[number] * widen**2, settings.drawn).to(prediction.velocity.dtype)
    one, seen = prediction.copies(number, 1), events.of(number)
    density = event_density(seen.pixels + one.plane_velocity(seen.pixels) * seen.age_s[..., None], seen.mask, prediction.objects.image_size)
    marks = mark(one, found.fit.contours, number, offsets, density)
    # The prediction itself is always among those that are tried.
    marks[0] = torch.inf
    offsets = offsets[marks.topk(min(count, len(marks))).indices]
    tried = _align_all(prediction.copies(number, len(offsets)), offsets, seen, config)
    share = torch.where(tried.count >= config.quality.min_observations, tried.share, 0)
    best = share.argmax()[None]
    mine = torch.where(found.count[number] >= config.quality.min_observations, found.share[number], 0.0)
    better = share.index_select(0, best) > mine + margin
    return found if readback.read_at_once(better) and not bool(better) else _replaced(found, number, tried, best, better)


def draw_offsets(covariance: Float[Tensor, "12 12"], count: int) -> Float[Tensor, "n 13"]:
    """Offsets of pose and velocity, drawn evenly from a covariance; the first is none. The swelling, last, is not drawn.

    The sequence is the same every time: a search can be repeated.
    """
    pose = _normal(count, covariance.dtype, covariance.device) @ torch.linalg.cholesky_ex(covariance[:6, :6]).L.T
    # A pose that is off implies a velocity that was.
    velocity = pose @ torch.linalg.solve_ex(covariance[:6, :6], covariance[:6, 6:]).result
    return torch.nn.functional.pad(torch.cat([pose, velocity], -1), (0, 1))


@lru_cache(maxsize=8)
def _normal(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "n 6"]:
    """Normally distributed numbers, spread evenly; the first are none."""
    with torch.inference_mode(mode=False):
        even = torch.quasirandom.SobolEngine(6, scramble=False).draw(count + 1)[1:].to(device, dtype)
        normal = torch.erfinv(2 * even - 1) * 2**0.5
        normal[0] = 0
        return normal


def event_density(pixels: Float[Tensor, "1 e 2"], mask: Bool[Tensor, "1 e"], image_size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """Events in the 3x3 pixels around every pixel of the image with its border."""
    height, width = (size + 2 * _BORDER_PX for size in image_size)
    place = (pixels[0].round() + _BORDER_PX).nan_to_num(-1)
    inside = mask[0] & (place >= 1).all(-1) & (place[:, 0] < width - 1) & (place[:, 1] < height - 1)
    u, v = torch.where(inside[:, None], place, 0).long().unbind(-1)
    image = torch.zeros(height * width, dtype=pixels.dtype, device=pixels.device)
    image = image.scatter_add(0, v * width + u, inside.to(pixels.dtype)).view(height, width)
    rows = image[:-2] + image[1:-1] + image[2:]
    return torch.nn.functional.pad(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:], (1, 1, 1, 1))


def mark(
    prediction: Prediction, contours: Contours, number: int, offsets: Float[Tensor, "n 13"], density: Float[Tensor, "h w"]
) -> Float[Tensor, "n"]:
    """How much denser events are on the contours of each pose than beside them.

    The contours are those of one pose, moved: over a few degrees they stay contours, even on a smooth surface.

    Args:
        prediction: of the one object.
        contours: of all objects, of which this is ``number``.
    """
    chosen, exists = _marked_points(contours.mask[number])
    points, normals = contours.points_obj[number, chosen], contours.normals[number, chosen]
    count, objects = len(offsets), prediction.objects
    poses = retract_about(prediction.T_cam_obj.expand(count, 4, 4), offsets[:, :6], objects.centre_obj.expand(count, 3))
    pixels = project(transform_points(poses, points.expand(count, -1, -1)), objects.intrinsics.expand(count, 4))
    limit = constant((density.shape[1] - 1, density.shape[0] - 1), pixels.dtype, pixels.device)
    total = pixels.new_zeros(count)
    for side_px, weight in ((0.0, 1.0), (_BESIDE_PX, -0.5), (-_BESIDE_PX, -0.5)):
        u, v = torch.minimum(((pixels + side_px * normals).round() + _BORDER_PX).clamp(min=0), limit).long().unbind(-1)
        total = total + weight * (density.flatten()[v * density.shape[1] + u].clamp(max=_ENOUGH_EVENTS) * exists).sum(-1)
    return total


def _marked_points(visible: Bool[Tensor, "m"]) -> tuple[Int[Tensor, "k"], Bool[Tensor, "k"]]:
    """Every so manieth of the visible points, fewer than twice those that poses are marked by, and which of them exist."""
    cumulative = visible.cumsum(0)
    step = torch.div(cumulative[-1:], _MARKED_POINTS, rounding_mode="floor").clamp(min=1)
    rank = torch.arange(2 * _MARKED_POINTS - 1, device=visible.device) * step
    chosen, exists = torch.searchsorted(cumulative, rank + 1).clamp(max=len(visible) - 1), rank < cumulative[-1:]
    # On a GPU, which would have to be waited for to know how many they are, all keep their places.
    return (chosen[exists], exists[exists]) if readback.read_at_once(exists) else (chosen, exists)


def _align_all(copies: Prediction, offsets: Tensor, seen: WindowEvents, config: TrackerConfig) -> Found:
    """Align copies of one object, each from its own offset, on the events of the object."""
    begin = copies.moved(offsets)
    contours = copies.objects.contours(begin.T_cam_obj, config.contours)
    tight = torch.ones_like(offsets[:, 0])
    index = index_for(contours, copies.objects.image_size, config, tight)
    events = seen.repeated(len(offsets))
    observations = select_events(events, index, begin.plane_velocity(events.pixels), config.matching.max_events)
    return judge_fit(copies, align(copies, contours, index, tight, observations, config, offsets), config)


def _replaced(found: Found, number: int, other: Found, row: Int[Tensor, "1"], better: Bool[Tensor, "1"]) -> Found:
    """``found`` with one object's poses, contours and quality from a row of another, where that is better."""

    def put(mine: Tensor, theirs: Tensor) -> Tensor:
        value = mine.clone()
        value[number] = torch.where(better.view([1] * mine.dim()), theirs.index_select(0, row), mine[number : number + 1])[0]
        return value

    mine, theirs = found.fit, other.fit
    solution = Linearisation(*(put(value, getattr(theirs.solution, name)) for name, value in vars(mine.solution).items()))
    count = max(mine.contours.mask.shape[1], theirs.contours.mask.shape[1])
    own, others = mine.contours.widened(count), theirs.contours.widened(count)
    contours = Contours(*(put(value, getattr(others, name)) for name, value in vars(own).items()))
    return Found(Fit(solution, contours, mine.matches), put(found.measured, other.measured), put(found.count, other.count))
