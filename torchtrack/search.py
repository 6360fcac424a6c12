"""Many poses tried at once, where an object's prediction is too uncertain for one."""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtrack import lie, quality
from torchtrack.alignment import Alignment, AlignmentResult, align, index_for
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
    carried = torch.linalg.solve(pose, covariance[:6, 6:])
    return torch.cat([drawn, drawn @ carried], -1)


def repeated(model: ContourModel, count: int) -> ContourModel:
    clone = copy.copy(model)
    clone._buffers = dict(model._buffers)
    clone._buffers["members"] = torch.arange(count)
    return clone


def search(tracker, start: Alignment, k: int, covariance: Tensor, pixels, age_s, polarity, mask, count: int):
    model = next(m for m in tracker.models if (m.members == k).any())
    model = repeated(model, count)
    config = tracker.config
    dtype = start.velocity.dtype
    delta = offsets(covariance.double(), count).to(dtype)
    row = lambda t: t[k : k + 1].expand(count, *t.shape[1:])
    T_start = lie.retract_about(row(start.T_prior), delta[:, :6], row(start.centre_obj))
    many = Alignment(row(start.T_prior), row(start.usable), row(start.prior_information), row(start.prior_covariance), row(start.velocity), row(start.centre_obj), row(start.intrinsics), start.image_size)
    one = Alignment(T_start, many.usable, many.prior_information, many.prior_covariance, many.velocity + delta[:, 6:], many.centre_obj, many.intrinsics, many.image_size)

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
