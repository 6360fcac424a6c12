"""What kernels go by: settings and constants of the pipeline, as plain numbers. Making them takes no Numba."""

from typing import NamedTuple

from torchtrack.backends.alignment import DampingSettings, MatchingSettings
from torchtrack.tracking.validation.verdict import Limits


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


class ArrivalSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.arrival_flow` goes by: constants of :mod:`torchtrack.tracking.frontend.arrival_flow`, and settings."""

    span_us: int
    min_pixels: int
    plane_s: float
    cut_off_us: int
    bound: float
    least_scale_s: float
    least_determinant: float
    slope_sigmas: float
    least_spread_px2: float
    least_slope2: float
    long_ago_us: int
    iterations: int


class CornerSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.corners` goes by: constants of :mod:`torchtrack.tracking.frontend.corners`, and settings."""

    relative_threshold: float
    reach_px: int
    largest_of_px: int
    oldest_us: int
    cell_px: int
    most: int
    snap_px: int


class AgreementSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.flow_agreement` goes by: constants of :mod:`torchtrack.tracking.association.flow_agreement`."""

    sigma_share: float
    sigma_px_s: float
    sigma_sine: float
    least_trust: float
    usual: float
    unseen_s: float


class RoundSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.rounds` goes by: settings, and constants of :mod:`estimation.levenberg_marquardt`."""

    matching: MatchingSettings
    damping: DampingSettings
    compensated: bool
    velocity_in_window: bool


class SolvingSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.solving` goes by beside that.

    Args:
        loss: none (0), Huber (1) or Tukey (2).
        rounding: share of a cost that it is known to.
        least_raised, growth, decay: damping after a step that was rejected is no less, times that; after another, times this.
    """

    iterations: int
    loss: int
    rounding: float
    least_raised: float
    growth: float
    decay: float


class IndexSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.index` goes by: constants of :mod:`torchtrack.tracking.contours.index`, and the image.

    Args:
        middle_u, middle_v: of the image (px).
        side_px: of a cell.
        margin: cells around the points of a region.
        distance_steps: squared distances are compared in so many parts of a pixel².
        half_diagonal: from the middle of a cell to its corner, in cells.
        far_cells: where a region without points begins.
    """

    middle_u: float
    middle_v: float
    side_px: float
    margin: int
    distance_steps: int
    half_diagonal: float
    far_cells: int


class TableSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.contour_table` goes by.

    Args:
        silhouette, crease, texture: numbers of kinds of contours.
        of_texture: whether anything is expected of texture.
    """

    silhouette: int
    crease: int
    texture: int
    of_texture: bool


class GridSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.depth_buffer` goes by: the layout of depth buffers.

    Args:
        rows, columns: of each stream's.
        side_px: of a cell.
        height, width: of the image (px).
        steps_per_m: depths are compared in so many parts of a metre.
        least_depth_m: what is nearer is not drawn.
        object_bits, nothing: how depths are kept: above so many bits for the object's number; and what is kept where there is nothing.
        samples_per_cell: so many surface samples for each cell of the square around an object are enough.
        samples_per_square: holes are closed that are smaller than a square of so many samples.
        most_cells: squares have no more cells a side.
    """

    rows: int
    columns: int
    side_px: float
    height: int
    width: int
    steps_per_m: float
    least_depth_m: float
    object_bits: int
    nothing: int
    samples_per_cell: int
    samples_per_square: int
    most_cells: int


class SamplingSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.sampling` goes by: settings, and constants of :mod:`torchtrack.tracking.contours.sampling`.

    Args:
        most_edges: of more active edges, as many are taken.
        max_edge_points: points on edges, at most.
        spacing_px: points are no closer than this in the image.
        texture: number of that kind.
        resolved_px: edges of it so far from opposite ones are resolved in full.
        least_cosine: texture seen at a smaller one is left out.
        least_depth_m: what is nearer is not seen.
    """

    most_edges: int
    max_edge_points: int
    spacing_px: float
    texture: int
    resolved_px: float
    least_cosine: float
    least_depth_m: float


class ShowingSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.points` goes by.

    Args:
        least_depth_m: what is nearer is not seen.
        least_px_per_m: tangents that the image shows shorter have no direction in it.
    """

    least_depth_m: float
    least_px_per_m: float


class TileSettings(NamedTuple):
    """What :func:`torchtrack.backends.numba.tiles.near_tiles` goes by.

    Args:
        sigmas: objects are expected within so many standard deviations of their prediction.
        margin_px: how far from an object what is near it is.
        least_depth_m: what is nearer to the camera is not seen.
    """

    sigmas: float
    margin_px: float
    least_depth_m: float


class QualitySettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.measures` goes by: settings, and constants of :mod:`validation.measures` and ``matching``."""

    min_observations: int
    min_on_contour: int
    min_speed_px_s: float
    least_ratio: float
    min_moving_points: int
    texture: int
    around_px: float
    on_contour_px: float
    smear_px: float
    patch_bits: int
    patches: int


class ForecastSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.forecast` goes by: settings, and constants of :mod:`torchtrack.tracking.motion.model` and ``prediction``.

    Args:
        holds: whether objects are expected to stay where they are.
        turn_s: time constant; 0 for what does not die away.
        most_uncertain: what would be less certain (rad, and diameters) is left as it is.
        least_depth_m, most_depth_m: between these a pose is usable.
    """

    holds: bool
    turn_s: float
    acceleration_rate_hz: float
    acceleration_floor_m_s2: float
    most_uncertain: float
    least_depth_m: float
    most_depth_m: float


class ConclusionSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.conclusion` goes by.

    Args:
        limits: of verdicts.
        coast_s: time in which the velocity of what failed fades.
    """

    limits: Limits
    observation_px: float
    coast_s: float


class PatchSettings(NamedTuple):
    """What :mod:`torchtrack.backends.numba.silhouette_features` goes by: constants of :mod:`torchtrack.tracking.association.weighting_features`.

    Args:
        across_px, along_px: where the patch is sampled.
        side: pixels of a side of what events are counted in, a power of two.
        border_px: of the table of sensor pixels.
        silhouette: number of the kind of contours whose observations are described.
        of_kind: where the kinds begin in a description, after counts and ages.
        slow_px_s: slower, an edge has no direction; ``unit_px_s`` that speeds are told in.
        oldest_px: ages are told up to this, by the way of the edge.
    """

    across_px: tuple[float, ...]
    along_px: tuple[float, ...]
    side: int
    border_px: int
    silhouette: int
    of_kind: int
    slow_px_s: float
    unit_px_s: float
    oldest_px: float
