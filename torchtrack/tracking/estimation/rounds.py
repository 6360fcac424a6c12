"""One window's alignment: rounds of matching and solving with ever tighter gates."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import constant, once
from torchtrack.core.dispatch import accelerable
from torchtrack.core.host_sync import AsyncValue
from torchtrack.tracking.association.along_flow import match_along_flow
from torchtrack.tracking.association.matches import MatchesWithCues, both_coordinates
from torchtrack.tracking.association.nearest import ContourTable, Gate, contour_table, match_nearest
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import INDEX_CELL_PX, ContourIndex, index_contours
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.estimation.implicit_gradient import with_gradient
from torchtrack.tracking.estimation.levenberg_marquardt import solve_pose
from torchtrack.tracking.estimation.terms import CostTerm, Linearisation, PoseProblem, WindowTerms
from torchtrack.tracking.frontend.sensors import MAX_GATE_PX
from torchtrack.tracking.motion.prediction import Prediction

# The index reaches this much beyond the first gate, so that an observation that a round moved is still found (px).
_INDEX_MARGIN_PX = 2
# Width of an uncertain object's first gate, in standard deviations of its prediction. Gates that do not open gave 0.30° / 0.71 mm as well
# (docs/results.md), on sequences where no prediction is uncertain.
GATE_SIGMAS = 3.0
# Of objects smaller than this in the image (px), contours are looked up between the cells of the index, if their place is not uncertain. So they are
# of larger ones of which more is seen than plain faces. By cells for all, errors are 0.31° / 0.72 mm instead of 0.30° / 0.71 mm (docs/results.md),
# and were a fifth larger on print when that was measured alone.
FINE_BELOW_PX = 120.0


@dataclass(frozen=True)
class Fit:
    """The poses after the last round, and what they stand on.

    Args:
        solution: the solver's last linearisation.
        contours: at the poses.
        matches: of the last round.
    """

    solution: Linearisation
    contours: Contours
    matches: MatchesWithCues


def gate_scale_of(sigma_px: Float[Tensor, "b"], config: TrackerConfig) -> Float[Tensor, "b"]:
    """How many times wider than configured the first gate is, for predictions of that standard deviation: at least 1."""
    return (GATE_SIGMAS * sigma_px / config.association.gates_px[0]).clamp(1, _widest_scale(config))


def _widest_scale(config: TrackerConfig) -> float:
    return max(MAX_GATE_PX / config.association.gates_px[0], 1.0) if config.uses(Component.WIDE_GATES) else 1.0


def index_radius(gate_scale: Float[Tensor, "b"], config: TrackerConfig) -> Int[Tensor, "b"]:
    """How far contours are to be found for each object's first gate (px)."""
    return (gate_scale * max(config.association.gates_px)).long() + _INDEX_MARGIN_PX


def usual_index_radius(config: TrackerConfig) -> int:
    """The same for an object whose first gate is as configured."""
    return int(max(config.association.gates_px)) + _INDEX_MARGIN_PX


def widest_index_radius(config: TrackerConfig) -> int:
    """The same for one that hardly anything is known of."""
    return int(_widest_scale(config) * max(config.association.gates_px)) + _INDEX_MARGIN_PX


def index_for(
    contours: Contours, image_size: tuple[int, int], config: TrackerConfig, gate_scale: Float[Tensor, "b"], radius_px: AsyncValue | None = None
) -> ContourIndex:
    """The index of contours, wide enough for each object's first gate.

    Args:
        radius_px: :func:`index_radius`, where it was asked for ahead.
    """
    return index_contours(contours, image_size, radius_px or AsyncValue.to(index_radius(gate_scale, config)), INDEX_CELL_PX)


@dataclass(frozen=True)
class Start:
    """Where the rounds of an alignment begin.

    Args:
        prediction: what the prior draws to.
        contours: visible where the rounds begin, and ``index`` of them.
        gate_scale: of each object's first gate; it is taken back by the last.
        offset: of the beginning from the prediction: pose and velocity; none when not given.
        extra_terms: of every round's cost, beside contour distances and prior.
    """

    prediction: Prediction
    contours: Contours
    index: ContourIndex
    gate_scale: Float[Tensor, "b"]
    offset: Float[Tensor, "b 12"] | None = None
    extra_terms: tuple[CostTerm, ...] = ()

    @once
    def begin(self) -> Prediction:
        """The objects where the rounds begin."""
        return self.prediction if self.offset is None else self.prediction.moved(self.offset)

    def from_prior(self, information: Float[Tensor, "b k k"]) -> Float[Tensor, "b k"]:
        """The offset, in the unknowns that the prior has information of."""
        return torch.zeros_like(information[:, 0]) if self.offset is None else self.offset


@dataclass(frozen=True)
class Gates:
    """How far observations are looked for from contours.

    Args:
        wider: by how much each round's gate is wider, for each object.
        subcell_lookup: objects whose contours are looked up between the cells of the index.
    """

    wider: Float[Tensor, "r b"]
    subcell_lookup: Bool[Tensor, "b"]


def align(start: Start, observations: Observations, config: TrackerConfig) -> Fit:
    """Match and solve, one round per gate.

    Gradients are those of the last round's problem at its solution: what came before chose the matches, which do not bend.
    """
    objects = start.prediction.objects
    table = _table(start.contours, start.index, objects, config)
    gates = Gates(_narrowing(start.gate_scale, len(config.association.gates_px)), _needs_subcell_lookup(start, table, config))
    solution, matches, contours = align_rounds(start, table, observations, gates, config)
    return Fit(solution, reproject(contours, solution.T_cam_obj, objects.intrinsics), matches)


@accelerable
def align_rounds(
    start: Start, table: ContourTable, observations: Observations, gates: Gates, config: TrackerConfig
) -> tuple[Linearisation, MatchesWithCues, Contours]:
    """Rounds of matching and solving: the solution and the matches of the last one, and the contours that these are of.

    Args:
        table: of the contours where the rounds begin.
    """
    prediction, begin, contours = start.prediction, start.begin, start.contours
    objects, matching, information = prediction.objects, config.association, prior_information(prediction, config)
    offset, place = start.from_prior(information), first_place(begin, observations, config)
    for number, (gate_px, wider) in enumerate(zip(matching.gates_px, gates.wider, strict=True)):
        if number and config.contours.source == "splat":
            contours = objects.contours(begin.T_cam_obj, config.contours)
            index = index_for(contours, objects.image_size, config, start.gate_scale, start.index.radius_px)
            table = _table(contours, index, objects, config)
            place = first_place(begin, observations, config)
        moving = begin.moving(compensated=matching.motion_compensation)
        if matching.search == "along_flow":
            contours = reproject(contours, begin.T_cam_obj, objects.intrinsics)
            matches = match_along_flow(observations, contours, moving, gate_px)
        else:
            matches, place = match_nearest(observations, table, place, moving, Gate(gate_px, wider, gates.subcell_lookup), config)
        matches = _believed(matches, observations, config)
        problem = _problem(start, information, matches, offset, gate_px * wider, config)
        solution = solve_pose(problem, begin.T_cam_obj, config.solver, offset)
        begin, offset = prediction.at(solution.T_cam_obj, solution.from_prior), solution.from_prior
    return with_gradient(problem, solution, config.solver), matches, contours


def _table(contours: Contours, index: ContourIndex, objects: ObjectBatch, config: TrackerConfig) -> ContourTable:
    """What observations take from contours, with the polarity that is expected of them."""
    return contour_table(contours, index, objects.polarity, of_texture=config.uses(Component.TEXTURE_POLARITY))


def _needs_subcell_lookup(start: Start, table: ContourTable, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Of which objects contours are looked up between the cells of the index: small ones, and those that show texture or smooth silhouettes.

    Others of plain faces are not: their models may lack texture, whose events then find the nearest edge all the more surely.
    """
    if not config.uses(Component.SUBCELL_LOOKUP):
        return torch.zeros_like(table.not_plain)
    subcell_lookup = (start.prediction.objects.size_px(start.begin.T_cam_obj).detach() < FINE_BELOW_PX) | table.not_plain
    # One that may be far off would settle on the first edges that it is nearest to.
    return subcell_lookup & (start.gate_scale <= 1)


def _narrowing(gate_scale: Float[Tensor, "b"], rounds: int) -> Float[Tensor, "r b"]:
    """How many times wider than configured the gate of every round is: as given at first, not at all at last."""
    left = tuple((1 - number / max(rounds - 1, 1),) for number in range(rounds))
    return gate_scale ** constant(left, gate_scale.dtype, gate_scale.device)


def first_place(begin: Prediction, observations: Observations, config: TrackerConfig) -> Float[Tensor, "b n 2"]:
    """Where the first round looks for each observation: carried to the window's end with the object's plane."""
    if not config.association.motion_compensation:
        return observations.pixels
    return begin.carried(observations.pixels, observations.age_s)


def prior_information(prediction: Prediction, config: TrackerConfig) -> Float[Tensor, "b k k"]:
    """Information of the prediction in the solver's chart, for observations of unit weight: of pose and velocity, or none of the pose."""
    if not config.solver.prior:
        return prediction.velocity.new_zeros(len(prediction.velocity), 6, 6)
    return (config.solver.observation_px**2 * prediction.information).to(prediction.velocity.dtype)


def _believed(matches: MatchesWithCues, observations: Observations, config: TrackerConfig) -> MatchesWithCues:
    """The matches with weights that hold all there is to be said: none for what has no match, or an object with too few of them."""
    weights = matches.weights * matches.mask
    if observations.trust is not None:
        weights = weights * observations.trust
    enough = weights.sum(-1, keepdim=True) >= config.validation.min_observations
    return replace(matches, mask=matches.mask & enough, weights=weights * enough * matches.effective)


def _problem(
    start: Start,
    information: Float[Tensor, "b k k"],
    matches: MatchesWithCues,
    offset: Float[Tensor, "b k"],
    gate_px: Float[Tensor, "b"],
    config: TrackerConfig,
) -> PoseProblem:
    """The least squares problem of one round; objects without a match stay where they are."""
    prediction = start.prediction
    rows = both_coordinates(matches) if config.association.residual == "point" else matches
    return PoseProblem(
        points_obj=rows.points_obj,
        targets=rows.targets,
        directions=rows.directions,
        weights=rows.weights,
        intrinsics=prediction.objects.intrinsics,
        centre_obj=prediction.objects.centre_obj,
        scale_px=gate_px,
        T_prior=prediction.T_cam_obj,
        prior_information=information,
        window=_window_terms(rows, offset, config) if config.solver.prior else None,
        extra_terms=start.extra_terms,
    )


def _window_terms(rows: MatchesWithCues, offset: Float[Tensor, "b 12"], config: TrackerConfig) -> WindowTerms:
    """What observations tell beside the pose: of the velocity, by their ages."""
    return WindowTerms(rows.age_s if config.uses(Component.VELOCITY_IN_WINDOW) else torch.zeros_like(rows.age_s), offset[:, 6:])
