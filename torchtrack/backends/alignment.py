"""What kernels of the rounds of matching and solving take and give, whichever library they are written with."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import SolverConfig, TrackerConfig
from torchtrack.tracking.association import weights
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.estimation import levenberg_marquardt as lm

# Rows of what was observed.
U, V, AGE, POLARITY, TRUST = range(5)
OBSERVED = 5
# Columns of a contour point: its place on the object, its normal, where it was indexed, and marks.
X, Y, Z, NORMAL_U, NORMAL_V, INDEXED_U, INDEXED_V, SMOOTH, ORIENTED, EXPECTED = range(10)
COLUMNS = 10
# Rows of a match.
WEIGHT, MATCH_AGE, POINT_X, POINT_Y, POINT_Z, TARGET_U, TARGET_V, DIRECTION_U, DIRECTION_V = range(9)
OFFSET, DARK, AS_EXPECTED, EFFECTIVE = range(9, 13)
ROWS = 13
# Unknowns: pose and velocity.
UNKNOWNS = 12


class MatchingSettings(NamedTuple):
    """What matching goes by: settings, and constants of :mod:`torchtrack.tracking.association.weights`."""

    dark_shift_px: float
    silhouette_dark_shift_px: float
    polarity_gain: float
    least_agreement: float
    smeared_share: float
    gathered_share: float
    least_trust: float
    concentration: bool
    polarity: bool
    slow_px_s: float
    on_contour_px: float
    smear_px: float
    patch_bits: int
    patches: int
    min_observations: int
    common_variance: float


class DampingSettings(NamedTuple):
    """How a Hessian is damped along its diagonal, as :mod:`torchtrack.tracking.estimation.levenberg_marquardt` does.

    Args:
        damping: share of each entry, at first.
        least_diagonal, least_share: what is added beside it: so much, and this share of the pose's largest entry.
    """

    damping: float
    least_diagonal: float
    least_share: float


def knows(config: TrackerConfig) -> bool:
    """Whether kernels of all rounds do what is set: the settings of the preset ``default``, and most beside them."""
    matching, solver = config.association, config.solver
    usual = solver.prior and solver.iterations == 1 and solver.loss == "tukey" and config.contours.source == "mesh"
    return usual and matching.search != "along_flow" and matching.residual == "normal"


def matching_settings(config: TrackerConfig) -> MatchingSettings:
    """What matching goes by."""
    step_px, silhouette_px = weights.dark_shifts_px(config)
    # One by one, as a compiler of graphs has to follow it.
    return MatchingSettings(
        dark_shift_px=step_px,
        silhouette_dark_shift_px=silhouette_px,
        polarity_gain=weights.POLARITY_GAIN,
        least_agreement=weights.LEAST_AGREEMENT,
        smeared_share=weights.SMEARED_SHARE,
        gathered_share=weights.GATHERED_SHARE,
        least_trust=weights.LEAST_TRUST,
        concentration=config.association.concentration,
        polarity=config.association.polarity,
        slow_px_s=weights.SLOW_PX_S,
        on_contour_px=weights.ON_CONTOUR_PX,
        smear_px=weights.SMEAR_PX,
        patch_bits=weights.PATCH_BITS,
        patches=weights.PATCHES,
        min_observations=config.validation.min_observations,
        common_variance=weights.common_variance(config),
    )


def damping_settings(config: SolverConfig, hessian: Float[Tensor, "b k k"]) -> DampingSettings:
    """What a kernel goes by that damps Hessians like this one."""
    return DampingSettings(config.damping, lm.LEAST_DIAGONAL, lm.least_share(hessian))


def observed_rows(observations: Observations) -> Float[Tensor, "b 5 n"]:
    """Rows of what was observed."""
    trust = torch.ones_like(observations.age_s) if observations.trust is None else observations.trust
    return torch.stack([*observations.pixels.unbind(-1), observations.age_s, observations.polarity, trust], 1)


def matches_of(
    contour: Int[Tensor, "b n"], is_near: Bool[Tensor, "b n"], is_matched: Bool[Tensor, "b n"], rows: Float[Tensor, "b 13 n"]
) -> MatchesWithCues:
    """The matches as the pipeline knows them."""
    weights, age_s, points, targets, directions, *rest = rows.split((1, 1, 3, 2, 2, 1, 1, 1, 1), 1)
    offsets, dark, as_expected, effective = (value[:, 0] for value in rest)
    points_obj, targets, directions = (value.transpose(1, 2) for value in (points, targets, directions))
    geometry = weights[:, 0], age_s[:, 0], points_obj, targets, directions, offsets
    return MatchesWithCues(contour, is_matched, *geometry, is_near, as_expected, dark, effective)
