"""The rounds of :func:`torchtrack.tracking.estimation.rounds.align_rounds` on a GPU: three kernels a round, and no value read back."""

from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor

from torchtrack.backends.alignment import (
    ROWS,
    DampingSettings,
    MatchingSettings,
    damping_settings,
    knows,
    matches_of,
    matching_settings,
    observed_rows,
)
from torchtrack.backends.triton import matching, solving
from torchtrack.backends.triton.compiler import OPTIONS
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.association.nearest import ContourTable
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import OFF_BORDER_PX
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation import rounds
from torchtrack.tracking.estimation.rounds import Gates, Start
from torchtrack.tracking.estimation.terms import Linearisation

# Observations that a program takes at a time.
_BLOCK = 128


def _supports(start: Start, table: ContourTable, observations: Observations, gates: Gates, config: TrackerConfig) -> bool:
    return knows(config) and not start.extra_terms and observations.mask.numel() > 0 and table.rows.shape[2] > 0


class _Given(NamedTuple):
    """What the rounds begin with: observations, contours and their index, objects, and gates."""

    seen: Tensor
    exists: Tensor
    place: Tensor
    table: Tensor
    nearest: Tensor
    first: Tensor
    T_cam_obj: Tensor
    centre_obj: Tensor
    intrinsics: Tensor
    velocity: Tensor
    predicted_velocity: Tensor
    information: Tensor
    offset: Tensor
    wider: Tensor
    subcell_lookup: Tensor


class _Layout(NamedTuple):
    """Numbers that the rounds go by, beside settings: of the index, and what is done at all."""

    cell_rows: int
    cell_columns: int
    cell_px: float
    motion_compensation: bool
    velocity_in_window: bool


_KINDS = MatchingSettings, DampingSettings, _Layout


@accelerates(rounds.align_rounds, supports=_supports, device="cuda", in_graphs=True)
def align_rounds_triton(
    start: Start, table: ContourTable, observations: Observations, gates: Gates, config: TrackerConfig
) -> tuple[Linearisation, MatchesWithCues, Contours]:
    """Object by object and block by block."""
    prediction, begin, information = start.prediction, start.begin, rounds.prior_information(start.prediction, config)
    matched_with, index = config.association, table.index
    layout = _Layout(*index.size, float(index.cell_px), matched_with.motion_compensation, config.uses(Component.VELOCITY_IN_WINDOW))
    numbers = [*matching_settings(config), *damping_settings(config.solver, information), *layout]
    given = [
        *(observed_rows(observations), observations.mask, rounds.first_place(begin, observations, config).transpose(1, 2)),
        *(table.rows, index.nearest, index.first),
        *(begin.T_cam_obj, prediction.objects.centre_obj, prediction.objects.intrinsics, begin.velocity, prediction.velocity),
        *(information, start.from_prior(information), gates.wider, gates.subcell_lookup),
    ]
    T_cam_obj, gradient, hessian, offset, contour, is_near, is_matched, matches = _rounds(
        given, list(matched_with.gates_px), list(map(float, numbers))
    )
    return Linearisation(T_cam_obj, gradient, hessian, offset), matches_of(contour, is_near, is_matched, matches), start.contours


@torch.library.custom_op("torchtrack::rounds", mutates_args=())
def _rounds(tensors: list[Tensor], gates_px: list[float], numbers: list[float]) -> list[Tensor]:
    """All rounds: an operation of PyTorch's, whose inside a compiler of graphs leaves alone.

    Args:
        tensors: those of :class:`_Given`.
        numbers: settings of matching and damping, and :class:`_Layout`.
    """
    given = _Given(*(tensor.contiguous() for tensor in tensors))
    settings, damping, layout = _of_their_kinds(numbers)
    (batch, count), points = given.exists.shape, given.table.shape[2]
    T_cam_obj, gradient, hessian, offset, contour, is_near, is_matched, matches = _room(given)
    # What the kernels write to are copies.
    T_cam_obj, offset, place = T_cam_obj.copy_(given.T_cam_obj), offset.copy_(given.offset), given.place.clone()
    of_index = layout.cell_rows, layout.cell_columns, layout.cell_px, OFF_BORDER_PX
    velocity, next_T_cam_obj = given.velocity, T_cam_obj.clone()
    with torch.cuda.device_of(offset):
        for gate_px, wider in zip(gates_px, given.wider, strict=True):
            votes = offset.new_zeros(batch, settings.patches**2, matching.VOTES)
            moving = velocity.contiguous() if layout.motion_compensation else torch.zeros_like(velocity)
            matching.match[batch, triton.cdiv(count, _BLOCK)](
                given.seen, given.exists, place, given.table, given.nearest, given.first, T_cam_obj, given.centre_obj, moving, given.intrinsics,
                wider, given.subcell_lookup, votes, contour, is_near, is_matched, matches, count, points, *of_index, gate_px,
                settings=settings, BLOCK=_BLOCK, **OPTIONS,
            )  # fmt: skip
            matching.believe[(batch,)](given.seen, votes, is_matched, matches, count, settings=settings, BLOCK=_BLOCK, **OPTIONS)
            solving.solve[(batch,)](
                matches, given.information, given.centre_obj, given.intrinsics, wider, T_cam_obj, next_T_cam_obj, offset, gradient, hessian,
                count, gate_px, velocity_in_window=layout.velocity_in_window, damping=damping, BLOCK=_BLOCK, **OPTIONS,
            )  # fmt: skip
            T_cam_obj, next_T_cam_obj = next_T_cam_obj, T_cam_obj
            velocity = given.predicted_velocity + offset[:, 6:]
    return [T_cam_obj, gradient, hessian, offset, contour, is_near, is_matched, matches]


@_rounds.register_fake
def _(tensors: list[Tensor], gates_px: list[float], numbers: list[float]) -> list[Tensor]:
    return _room(_Given(*tensors))


def _room(given: _Given) -> list[Tensor]:
    """Memory for what the rounds give: poses, gradients, Hessians and offsets; contour points, what is near and matched, and rows of matches."""
    (batch, count), offset = given.exists.shape, given.offset
    of_objects = (like.new_empty(like.shape) for like in (given.T_cam_obj, offset, given.information, offset))
    of_observations = (offset.new_empty(batch, count, dtype=kind) for kind in (torch.int64, torch.bool, torch.bool))
    return [*of_objects, *of_observations, offset.new_empty(batch, ROWS, count)]


def _of_their_kinds(numbers: list[float]) -> list[Any]:
    """Settings and layout, of numbers one after the other."""
    left = iter(numbers)
    return [kind(*(of_field(next(left)) for of_field in kind.__annotations__.values())) for kind in _KINDS]
