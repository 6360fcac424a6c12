"""What kernels go by: settings and constants of the pipeline, as plain numbers. Making them takes no Numba."""

from typing import NamedTuple


class Cells(NamedTuple):
    """The layout of an index.

    Args:
        rows, columns: of every object's region.
        side_px: of a cell.
        aside_px: how far beside a place its cell is looked up.
    """

    rows: int
    columns: int
    side_px: float
    aside_px: float


class MatchingSettings(NamedTuple):
    """What :mod:`torchtrack.kernels.matching` goes by: settings, and constants of :mod:`torchtrack.matching`."""

    burst_px: float
    dark_shift_px: float
    limb_dark_shift_px: float
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
    common_px2: float
    observation_px: float


class RoundSettings(NamedTuple):
    """What :mod:`torchtrack.kernels.rounds` goes by beside that: settings, and constants of :mod:`torchtrack.pose_solver`."""

    compensated: bool
    velocity_in_window: bool
    damping: float
    least_diagonal: float
    least_share: float
