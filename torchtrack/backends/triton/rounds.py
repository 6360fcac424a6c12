"""The rounds of :func:`torchtrack.tracking.estimation.rounds.align_rounds` on a GPU: three kernels a round, and no value read back."""

import torch
import triton

from torchtrack.backends.alignment import ROWS, damping_settings, knows, matches_of, matching_settings, observed_rows
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


@accelerates(rounds.align_rounds, supports=_supports, device="cuda")
def align_rounds_triton(
    start: Start, table: ContourTable, observations: Observations, gates: Gates, config: TrackerConfig
) -> tuple[Linearisation, MatchesWithCues, Contours]:
    """Object by object and block by block."""
    prediction, information = start.prediction, rounds.prior_information(start.prediction, config).contiguous()
    (batch, count), settings, matched_with = observations.mask.shape, matching_settings(config), config.association
    T_cam_obj, offset = (value.clone(memory_format=torch.contiguous_format) for value in (start.begin.T_cam_obj, start.from_prior(information)))
    centre_obj, intrinsics = prediction.objects.centre_obj.contiguous(), prediction.objects.intrinsics.contiguous()
    gradient, hessian = torch.empty_like(offset), torch.empty_like(information)
    contour = torch.empty(batch, count, dtype=torch.int64, device=offset.device)
    is_near, is_matched = torch.empty(2, batch, count, dtype=torch.bool, device=offset.device)
    matches, seen = offset.new_empty(batch, ROWS, count), observed_rows(observations)
    # What the kernels write to is a copy that lies row by row in memory.
    place = rounds.first_place(start.begin, observations, config).transpose(1, 2).clone(memory_format=torch.contiguous_format)
    of_table = table.rows.contiguous(), table.index.nearest.contiguous(), table.index.first.contiguous()
    layout = *table.index.size, float(table.index.cell_px), OFF_BORDER_PX
    velocity, next_T_cam_obj = start.begin.velocity, T_cam_obj.clone()
    with torch.cuda.device_of(offset):
        for gate_px, wider in zip(matched_with.gates_px, gates.wider, strict=True):
            votes = offset.new_zeros(batch, settings.patches**2, matching.VOTES)
            moving = velocity.contiguous() if matched_with.motion_compensation else torch.zeros_like(velocity)
            matching.match[batch, triton.cdiv(count, _BLOCK)](
                seen, observations.mask.contiguous(), place, *of_table, T_cam_obj, centre_obj, moving, intrinsics, wider, gates.subcell_lookup,
                votes, contour, is_near, is_matched, matches, count, table.rows.shape[2], *layout, gate_px,
                settings=settings, BLOCK=_BLOCK, **OPTIONS,
            )  # fmt: skip
            matching.believe[(batch,)](seen, votes, is_matched, matches, count, settings=settings, BLOCK=_BLOCK, **OPTIONS)
            solving.solve[(batch,)](
                matches, information, centre_obj, intrinsics, wider, T_cam_obj, next_T_cam_obj, offset, gradient, hessian, count, gate_px,
                velocity_in_window=config.uses(Component.VELOCITY_IN_WINDOW), damping=damping_settings(config.solver, information),
                BLOCK=_BLOCK, **OPTIONS,
            )  # fmt: skip
            T_cam_obj, next_T_cam_obj = next_T_cam_obj, T_cam_obj
            velocity = prediction.velocity + offset[:, 6:]
    return Linearisation(T_cam_obj, gradient, hessian, offset), matches_of(contour, is_near, is_matched, matches), start.contours
