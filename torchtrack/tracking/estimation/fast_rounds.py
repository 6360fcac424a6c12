"""The rounds of an alignment by a kernel, under the settings that it knows: those of the preset ``default``, and most beside them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.parameters import MatchingSettings, RoundSettings
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch
from torchtrack.core.constants import constant
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.association.nearest import ContourTable
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.association.weights import ON_CONTOUR_PX, PATCH_BITS, PATCHES, SLOW_PX_S, SMEAR_PX
from torchtrack.tracking.estimation.levenberg_marquardt import damping_settings
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.motion.prediction import Prediction


def applies(config: TrackerConfig, values: Tensor) -> bool:
    """Whether the kernel does all that is set, on tensors like these."""
    matching, solver = config.matching, config.solver
    usual = solver.prior and solver.iterations == 1 and solver.loss == "tukey" and not any(config.contours.refresh_rounds)
    nearest = not matching.along_flow and matching.residual == "normal" and not matching.mutual_px
    return usual and nearest and dispatch.apply_to(values)


def align_rounds(
    prediction: Prediction,
    T_cam_obj: Float[Tensor, "b 4 4"],
    offset: Float[Tensor, "b 13"],
    information: Float[Tensor, "b 13 13"],
    table: ContourTable,
    observations: Observations,
    wider: Float[Tensor, "r b"],
    finely: Bool[Tensor, "b"],
    config: TrackerConfig,
) -> tuple[Linearisation, Matches]:
    """The solution and the matches of the last round: what :func:`torchtrack.tracking.estimation.rounds.align` does in its loop.

    Args:
        prediction: what the prior draws to.
        T_cam_obj, offset: where the rounds begin, and how far from the prediction that is.
        information: of the prior.
        table: of the contours.
        wider: by how much each round's gate is wider, for each object.
        finely: objects whose contours are looked up finely.
    """
    # Not at the top: Numba is an extra.
    from torchtrack.backends.numba import matching as rows
    from torchtrack.backends.numba import rounds

    objects, (batch, count) = prediction.objects, observations.mask.shape
    # What the kernel writes to lies row by row in memory: of anything else it would be given a copy.
    T_cam_obj, offset = (value.clone(memory_format=torch.contiguous_format) for value in (T_cam_obj, offset))
    gradient, hessian = offset.new_empty(offset.shape), offset.new_empty(information.shape)
    contour = torch.empty(batch, count, dtype=torch.int64)
    is_near, is_matched = torch.empty(2, batch, count, dtype=torch.bool)
    matches = torch.empty(batch, rows.ROWS, count, dtype=offset.dtype)
    rounds.align(
        *as_arrays(_seen(observations), observations.mask, table.rows.transpose(1, 2), table.index.nearest, table.index.first),
        table.index.cells,
        *as_arrays(prediction.velocity, *_acceleration(prediction, config), information, objects.intrinsics, objects.centre_obj),
        *as_arrays(constant(config.matching.gates_px, offset.dtype, offset.device), wider, finely),
        _matching_settings(config),
        RoundSettings(config.matching.motion_compensation, config.solver.velocity_in_window),
        damping_settings(config.solver, information),
        *as_arrays(T_cam_obj, offset, gradient, hessian, contour, is_near, is_matched, matches),
    )
    return Linearisation(T_cam_obj, gradient, hessian, offset), _matches(contour, is_near, is_matched, matches)


def _matching_settings(config: TrackerConfig) -> MatchingSettings:
    """What a kernel goes by that matches as :func:`torchtrack.tracking.association.nearest.match_nearest` does."""
    matching = config.matching
    return MatchingSettings(
        burst_px=matching.burst_px,
        dark_shift_px=matching.dark_shift_px,
        limb_dark_shift_px=matching.limb_dark_shift_px,
        polarity_gain=matching.polarity_gain,
        least_agreement=matching.least_agreement,
        smeared_share=matching.smeared_share,
        gathered_share=matching.gathered_share,
        least_trust=matching.least_trust,
        concentration=matching.concentration,
        polarity=matching.polarity,
        slow_px_s=SLOW_PX_S,
        on_contour_px=ON_CONTOUR_PX,
        smear_px=SMEAR_PX,
        patch_bits=PATCH_BITS,
        patches=PATCHES,
        min_observations=config.quality.min_observations,
        common_px2=config.solver.common_px**2,
        observation_px=config.solver.observation_px,
    )


def _seen(observations: Observations) -> Float[Tensor, "b 6 n"]:
    """Rows of what was observed."""
    trust = torch.ones_like(observations.age_s) if observations.trust is None else observations.trust
    return torch.stack([*observations.pixels.unbind(-1), observations.age_s, observations.into_burst_s, observations.polarity, trust], 1)


def _acceleration(prediction: Prediction, config: TrackerConfig) -> tuple[Tensor, Tensor]:
    """The acceleration that is expected, and how much of it goes with velocities that were not; none where these do not change."""
    if prediction.acceleration is None or not config.solver.acceleration_in_window:
        return torch.zeros_like(prediction.velocity), torch.zeros_like(prediction.velocity)
    return prediction.acceleration.expected, prediction.acceleration.rate_hz


def _matches(contour: Tensor, is_near: Tensor, is_matched: Tensor, rows: Float[Tensor, "b 15 n"]) -> Matches:
    """The matches as the pipeline knows them."""
    weights, age_s, points, targets, directions, *rest = rows.split((1, 1, 3, 2, 2, 1, 1, 1, 1, 1, 1), 1)
    offsets, limb, beside, mistaken, dark, as_expected = (value[:, 0] for value in rest)
    points_obj, targets, directions = (value.transpose(1, 2) for value in (points, targets, directions))
    told = weights[:, 0], age_s[:, 0], points_obj, targets, directions, offsets
    return Matches(contour, is_matched, *told, is_near, limb, beside, mistaken, dark, as_expected)
