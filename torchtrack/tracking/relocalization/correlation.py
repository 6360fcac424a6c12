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
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.motion.prediction import Prediction
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
    """A part of the image, in cells.

    Args:
        middle: pixel in its middle.
        cell_px: side of a cell.
    """

    middle: Float[Tensor, "2"]
    cell_px: Float[Tensor, ""]

    def counts(self, pixels: Float[Tensor, "k n 2"], mask: Bool[Tensor, "k n"]) -> Float[Tensor, "k h w"]:
        """How many of the pixels of each row are in each cell."""
        place = ((pixels - self.middle) / self.cell_px + SIDE // 2).round().nan_to_num(-1.0)
        inside = mask & (place >= 0).all(-1) & (place < SIDE).all(-1)
        u, v = torch.where(inside[..., None], place, 0).long().unbind(-1)
        cells = pixels.new_zeros(len(pixels), SIDE**2)
        return cells.scatter_add(1, v * SIDE + u, inside.to(pixels.dtype)).unflatten(1, (SIDE, SIDE))


def kept_rotations(config: TrackerConfig) -> int:
    """How many of the rotations and places that are tried are pulled onto the events."""
    return max(int(_KEPT_RATIO * config.relocalization.rotations), 1)


def shifted(
    prediction: Prediction, steps: Float[Tensor, "n 6"], sigma_m: Float[Tensor, ""], places: tuple[Tensor, Tensor], config: TrackerConfig
) -> tuple[Float[Tensor, "k 6"], Contours]:
    """Offsets of an object's pose with most events on its contours, as many as :func:`kept_rotations` says, best first; and its outlines.

    Args:
        prediction: of the object.
        steps: offsets to try; of their moves, the way towards the camera alone.
        sigma_m: standard deviation of the moves across the image.
        places: pixels ``[1, e, 2]`` of the events at the window's end, and which of them exist.
    """
    objects, centre = prediction.objects, prediction.centre_cam[0]
    focal = objects.intrinsics[0, :2]
    ray, sigma_px = centre / centre[2], sigma_m * focal[0] / centre[2]
    cell_px = (_DIAMETERS * objects.size_px(prediction.T_cam_obj)[0] + 2 * _SIGMAS * sigma_px) / SIDE
    square = Square(ray[:2] * focal + objects.intrinsics[0, 2:], cell_px)
    steps = torch.cat([steps[:, :3], steps[:, 5:] * ray], 1)
    outlines = outlines_by_view(prediction, prediction.poses_at(steps), config)
    number, shift = _best(square, places, outlines, sigma_px / cell_px, kept_rotations(config))
    moved_m = shift * cell_px * ((centre[2] + steps[number, 5:]) / focal)
    return torch.cat([steps[number, :3], steps[number, 3:5] + moved_m, steps[number, 5:]], 1), outlines.rows(number)


def _best(
    square: Square, places: tuple[Tensor, Tensor], outlines: Contours, sigma_cells: Float[Tensor, ""], count: int
) -> tuple[Int[Tensor, "k"], Float[Tensor, "k 2"]]:
    """Numbers of the outlines that fit best, and their shifts (cells)."""
    step = torch.arange(SIDE, dtype=sigma_cells.dtype, device=sigma_cells.device) - SIDE // 2
    allowed = step[:, None].square() + step.square() <= (_SIGMAS * sigma_cells).square()
    best, place = (values.flatten() for values in highest(_denser(square.counts(*places)[0] / square.cell_px), outlines, square, allowed))
    chosen = best.topk(min(count, best.numel())).indices
    place = place[chosen]
    return chosen // SHIFTS, torch.stack([step[place % SIDE], step[place // SIDE]], -1)


def _denser(events: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """How much denser events are than around them, of which one for each pixel of a contour through the cell is enough."""
    enough = events.clamp(max=1)
    return _blurred(enough, _BLUR) - _blurred(enough, _AROUND)


def _blurred(cells: Float[Tensor, "h w"], radius: int) -> Float[Tensor, "h w"]:
    """The mean over so many cells to each side, one way after the other."""
    side = 2 * radius + 1
    return avg_pool2d(avg_pool2d(cells[None], (side, 1), 1, (radius, 0)), (1, side), 1, (0, radius))[0]


@accelerable
def highest(
    denser: Float[Tensor, "h w"], outlines: Contours, square: Square, allowed: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Of each outline, the shifts with most events on it, more than around it, and how many more for each of its points; no two of them are close.

    By spectra; where few shifts are allowed, kernels take less time to add up each of them.

    Args:
        denser: how much denser events are in each cell than around it.
        square: of the cells.
        allowed: which shifts count; none at all is in the middle.

    Returns:
        The fit, :data:`NONE` where there are not so many shifts, and the cell that each shift is in.
    """
    spectrum = rfft2(denser.roll((SIDE // 2, SIDE // 2), (0, 1)))
    together = _TOGETHER_ON_GPU if host_sync.on_gpu(denser) else _TOGETHER
    split = zip(outlines.pixels.split(together), outlines.mask.split(together), strict=True)
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
