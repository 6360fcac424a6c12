"""Many poses tried at once, where an object's prediction is too uncertain for one."""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtrack import lie, quality
from torchtrack.alignment import Alignment, AlignmentResult, align, index_for
from torchtrack.camera import project
from torchtrack.contours import ContourModel, Contours, mesh_contours
from torchtrack.observations import select_events
from torchtrack.pose_solver import Linearisation
from torchtrack.visibility import Scene, remove_hidden


def offsets(covariance: Tensor, count: int) -> Tensor:
    """``count`` offsets of pose and velocity ``[12]``: drawn evenly from the covariance; the first is zero."""
    sobol = torch.quasirandom.SobolEngine(6, scramble=False).draw(count + 1)[1:].to(covariance)
    normal = torch.erfinv(2 * sobol - 1) * 2**0.5
    normal[0] = 0
    pose = covariance[:6, :6]
    factor = torch.linalg.cholesky(pose)
    drawn = normal @ factor.T
    carried = torch.linalg.solve(pose, covariance[:6, 6:12])
    return torch.cat([drawn, drawn @ carried, torch.zeros_like(drawn[:, :1])], -1)


def repeated(model: ContourModel, count: int) -> ContourModel:
    clone = copy.copy(model)
    clone._buffers = dict(model._buffers)
    clone._buffers["members"] = torch.arange(count)
    return clone


_RING_PX, _ENOUGH, _POINTS = 4.0, 3.0, 200


def event_density(targets: Tensor, mask: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Events in the 3x3 neighbourhood of every pixel, with a border of two."""
    height, width = image_size[0] + 4, image_size[1] + 4
    u = (targets[..., 0].round().clamp(-1, width - 4) + 2).long()
    v = (targets[..., 1].round().clamp(-1, height - 4) + 2).long()
    image = torch.zeros(height * width, dtype=targets.dtype).scatter_add(0, v * width + u, mask.to(targets.dtype)).view(height, width)
    rows = image[:-2] + image[1:-1] + image[2:]
    return torch.nn.functional.pad(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:], (1, 1, 1, 1))


def ranked(start: Alignment, k: int, contours: Contours, density: Tensor, delta: Tensor) -> Tensor:
    step = max(contours.mask.shape[1] // _POINTS, 1)
    points, mask, normals = contours.points_obj[k, ::step], contours.mask[k, ::step], contours.normals[k, ::step]
    points, normals = points[mask], normals[mask]
    T = lie.retract_about(start.T_prior[k].expand(len(delta), 4, 4), delta[:, :6], start.centre_obj[k].expand(len(delta), 3))
    pixels = project(lie.transform_points(T, points.expand(len(delta), -1, -1)), start.intrinsics[k].expand(len(delta), 4))
    height, width = density.shape
    total = 0
    for side, weight in ((0.0, 1.0), (_RING_PX, -0.5), (-_RING_PX, -0.5)):
        place = (pixels + side * normals).round() + 2
        u, v = place[..., 0].clamp(0, width - 1).long(), place[..., 1].clamp(0, height - 1).long()
        total = total + weight * density.flatten()[v * width + u].clamp(max=_ENOUGH)
    return total.mean(-1)


def search(tracker, start: Alignment, k: int, covariance: Tensor, pixels, age_s, polarity, mask, count: int, seen: Contours):
    model = next(m for m in tracker.models if (m.members == k).any())
    model = repeated(model, count)
    config = tracker.config
    dtype = start.velocity.dtype
    delta = offsets(covariance.double(), config.search.drawn).to(dtype)
    plane = start.plane_velocity(pixels)
    density = event_density(pixels[k] + plane[k] * age_s[k, :, None], mask[k], start.image_size)
    marks = ranked(start, k, seen, density, delta)
    marks[0] = torch.inf
    delta = delta[marks.topk(count).indices]
    row = lambda t: t[k : k + 1].expand(count, *t.shape[1:])
    T_start = lie.retract_about(row(start.T_prior), delta[:, :6], row(start.centre_obj))
    many = Alignment(row(start.T_prior), row(start.usable), row(start.prior_information), row(start.prior_covariance), row(start.velocity), row(start.centre_obj), row(start.intrinsics), start.image_size)
    one = Alignment(T_start, many.usable, many.prior_information, many.prior_covariance, many.velocity + delta[:, 6:12], many.centre_obj, many.intrinsics, many.image_size)

    def extract(T: Tensor) -> Contours:
        contours = mesh_contours([model], T, many.intrinsics, config.contours)
        scene = Scene([model], T, many.intrinsics, torch.arange(count), tracker.diameter_m[k].expand(count), (count, *many.image_size), False)
        return remove_hidden(contours, scene, config.contours)

    contours = extract(T_start)
    index = index_for(contours, many.image_size, config)
    expand = lambda t: t[k : k + 1].expand(count, *t.shape[1:])
    observations = select_events(expand(pixels), expand(age_s), expand(polarity), expand(mask), index, one.plane_velocity(expand(pixels)), config.matching.max_events)
    ones = torch.ones(count)
    aligned = align(many, contours, index, ones, observations, extract, config, T_start, delta)
    velocity = many.contour_velocity(aligned.contours)
    share = quality.explained_share(aligned.contours, aligned.matches, velocity, many.image_size, config.quality.min_speed_px_s)
    number = aligned.matches.mask.sum(-1)
    share = torch.where(number >= config.quality.min_observations, share, 0)
    return share, number, aligned
