"""All shifts in the image at once: where the contours of an object, turned this way and that, lie on most events.

A pose has six unknowns, and thousands of draws from all of them come near a given pose but rarely. Two of them, the moves across
the image, need not be drawn: the correlation of an outline with the events tells of every shift what lies on it. What is
left to draw are rotations and depths, of which some hundreds are enough.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.fft import irfft2, rfft2
from torch.nn.functional import avg_pool2d

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.dispatch import accelerable
from torchtrack.core.neighbours import largest_around
from torchtrack.core.padded import repeated, rows_in_all
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.event_image import Places
from torchtrack.tracking.relocalization.view_sphere import outlines_by_view

# Cells a side of the square in which events and outlines are compared.
SIDE = 96
# Shifts are looked for within this many standard deviations, around an object that takes this many diameters.
_SIGMAS, _DIAMETERS = 2.5, 1.3
# Cells to each side that events are blurred over, and that their surroundings are taken from.
_BLUR, _AROUND = 1, 3
# Shifts that are kept of each rotation, the best within so many cells to each side.
SHIFTS, APART = 3, 2
# Outlines that are correlated together: what they need stays in a processor's nearer memory. On a GPU, what is asked for is what takes time.
_TOGETHER, _TOGETHER_ON_GPU = 32, 1024
# What is no shift at all: less than any correlation.
NONE = -9.0
# Of the rotations that are tried, the best of so many are pulled onto the events: 512 of 1000 (see :mod:`relocalization.sampling`).
_KEPT_RATIO = 0.512


@dataclass(frozen=True)
class Square:
    """A part of the image, in cells; of each of some objects, or of a single one.

    Args:
        middle: pixel in its middle.
        cell_px: side of a cell.
    """

    middle: Float[Tensor, "k 2"]
    cell_px: Float[Tensor, "k"]

    def of_object(self, number: int) -> "Square":
        """That of one object."""
        return Square(self.middle[number : number + 1], self.cell_px[number : number + 1])

    def counts(self, pixels: Float[Tensor, "n m 2"], mask: Bool[Tensor, "n m"]) -> Float[Tensor, "n h w"]:
        """How many of the pixels of each row are in each cell of the object's square, or of the single one."""
        place = ((pixels - self.middle[:, None]) / self.cell_px[:, None, None] + SIDE // 2).round().nan_to_num(-1.0)
        inside = mask & (place >= 0).all(-1) & (place < SIDE).all(-1)
        u, v = torch.where(inside[..., None], place, 0).long().unbind(-1)
        cells = pixels.new_zeros(len(pixels), SIDE**2)
        return cells.scatter_add(1, v * SIDE + u, inside.to(pixels.dtype)).unflatten(1, (SIDE, SIDE))


def kept_rotations(config: TrackerConfig) -> int:
    """How many of the rotations and places that are tried are pulled onto the events."""
    return max(int(_KEPT_RATIO * config.relocalization.rotations), 1)


def shifted(
    prediction: Prediction, steps: Float[Tensor, "n 6"], sigma_m: Float[Tensor, "k"], places: Places, config: TrackerConfig
) -> tuple[Float[Tensor, "m 6"], Contours]:
    """Offsets of poses with most events on the contours, as many of each object as :func:`kept_rotations` says, best first; and the outlines.

    Args:
        prediction: of the objects.
        steps: offsets to try, as many in turn of each object; of their moves, the way towards the camera alone.
        sigma_m: standard deviation of the moves across the image.
        places: of the events of each object.
    """
    objects, depth_m = prediction.objects, prediction.centre_cam[:, 2:]
    focal = objects.intrinsics[:, :2]
    ray, sigma_px = prediction.centre_cam / depth_m, sigma_m * focal[:, 0] / depth_m[:, 0]
    cell_px = (_DIAMETERS * objects.size_px(prediction.T_cam_obj) + 2 * _SIGMAS * sigma_px) / SIDE
    square = Square(ray[:, :2] * focal + objects.intrinsics[:, 2:], cell_px)
    steps = torch.cat([steps[:, :3], steps[:, 5:] * repeated(ray, len(steps))], 1)
    outlines = outlines_by_view(prediction, prediction.poses_at(steps), config)
    number, shift = _best(square, places, outlines, sigma_px / cell_px, kept_rotations(config))
    cell_px, depth_m, focal = (repeated(values, len(number)) for values in (cell_px[:, None], depth_m, focal))
    moved_m = shift * cell_px * ((depth_m + steps[number, 5:]) / focal)
    return torch.cat([steps[number, :3], steps[number, 3:5] + moved_m, steps[number, 5:]], 1), outlines.rows(number)


def _best(
    square: Square, places: Places, outlines: Contours, sigma_cells: Float[Tensor, "k"], count: int
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]]:
    """Numbers of the outlines of each object that fit best, and their shifts (cells)."""
    step = torch.arange(SIDE, dtype=sigma_cells.dtype, device=sigma_cells.device) - SIDE // 2
    allowed = step[:, None].square() + step.square() <= (_SIGMAS * sigma_cells).square()[:, None, None]
    denser, objects = _denser(square.counts(*places) / square.cell_px[:, None, None]), range(len(sigma_cells))
    of_objects = zip(*(values.tensor_split(len(objects)) for values in (outlines.pixels, outlines.mask)), strict=True)
    fits = [highest(denser[k], *own, square.of_object(k), allowed[k]) for k, own in zip(objects, of_objects, strict=True)]
    best, place = (torch.stack(values).flatten(1) for values in zip(*fits, strict=True))
    chosen = best.topk(min(count, best.shape[1])).indices
    place = place.gather(1, chosen).flatten()
    return rows_in_all(chosen // SHIFTS, best.shape[1] // SHIFTS), torch.stack([step[place % SIDE], step[place // SIDE]], -1)


def _denser(events: Float[Tensor, "k h w"]) -> Float[Tensor, "k h w"]:
    """How much denser events are than around them, of which one for each pixel of a contour through the cell is enough."""
    enough = events.clamp(max=1)
    return _blurred(enough, _BLUR) - _blurred(enough, _AROUND)


def _blurred(cells: Float[Tensor, "k h w"], radius: int) -> Float[Tensor, "k h w"]:
    """The mean over so many cells to each side, one way after the other."""
    side = 2 * radius + 1
    return avg_pool2d(avg_pool2d(cells, (side, 1), 1, (radius, 0)), (1, side), 1, (0, radius))


@accelerable
def highest(
    denser: Float[Tensor, "h w"], pixels: Float[Tensor, "n m 2"], mask: Bool[Tensor, "n m"], square: Square, allowed: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Of each outline, the shifts with most events on it, more than around it, and how many more for each of its points; no two of them are close.

    All outlines are of one object. By spectra; where few shifts are allowed, kernels take less time to add up each of them.

    Args:
        denser: how much denser events are in each cell than around it.
        pixels: of the outlines' points, and ``mask``, which of them exist.
        square: of the cells.
        allowed: which shifts count; none at all is in the middle.

    Returns:
        The fit, :data:`NONE` where there are not so many shifts, and the cell that each shift is in.
    """
    spectrum = rfft2(denser.roll((SIDE // 2, SIDE // 2), (0, 1)))
    together = _TOGETHER_ON_GPU if host_sync.on_gpu(denser) else _TOGETHER
    split = zip(pixels.split(together), mask.split(together), strict=True)
    best, place = zip(*(peaks(_correlation(spectrum, square.counts(*some)), allowed) for some in split), strict=True)
    return torch.cat(best), torch.cat(place)


def _correlation(spectrum: Tensor, outlines: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """How much more events there are on each outline than around it, for every shift; none at all is in the middle.

    Args:
        spectrum: of the events.
        outlines: the number of contour points.
    """
    fit = irfft2(rfft2(outlines).conj() * spectrum, s=(SIDE, SIDE))
    return fit.div_(outlines.sum((1, 2), keepdim=True).clamp(min=1))


def peaks(fit: Float[Tensor, "n h w"], allowed: Bool[Tensor, "h w"]) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """The highest cells of each map, none of which is close to a higher one, and which they are; of cells that are allowed alone."""
    fit = torch.where(allowed, fit, NONE)
    best, place = torch.where(fit >= largest_around(fit, APART), fit, NONE).flatten(1).topk(SHIFTS)
    return best, place
