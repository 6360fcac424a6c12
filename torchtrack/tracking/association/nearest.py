"""Association of observations with the nearest contour point, within a gate: the one of the preset ``default``.

On a CPU without gradients, ``torchtrack/backends/numba/rounds.py`` takes its place, with all rounds of matching and solving in one call.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerable
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.association.polarity import octant
from torchtrack.tracking.association.weights import (
    agreeing,
    dark_shift_px,
    effective_weight,
    leading_side,
    match_weights,
)
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours


@dataclass(frozen=True)
class ContourTable:
    """What observations take from their contour point, laid out in rows.

    Args:
        rows: the values of all contour points, laid out so that one selection takes them for all observations.
        index: the contour point nearest to each place in the image.
        not_plain: objects of which texture or smooth silhouettes are seen.
    """

    rows: Float[Tensor, "b k m"]
    index: ContourIndex
    not_plain: Bool[Tensor, "b"]

    def take(self, contour: Int[Tensor, "b n"]) -> tuple[Tensor, ...]:
        """Of contour points: places on the object, normals, pixels when indexed; smooth silhouette or not, oriented or not, darker side."""
        taken = self.rows.gather(2, contour[:, None].expand(-1, self.rows.shape[1], -1)).transpose(1, 2)
        points_obj, normals, indexed, marks = taken.split((3, 2, 2, 3), -1)
        return points_obj, normals, indexed, *marks.unbind(-1)


@accelerable
def contour_table(contours: Contours, index: ContourIndex, polarity: Float[Tensor, "b 8"] | None = None, *, of_texture: bool = True) -> ContourTable:
    """The table of contours and their index.

    The normals of the mesh's own edges are oriented: they point outwards. Those of texture point to its darker side.

    Args:
        polarity: expected of the mesh's own edges, by the octant that they face (:func:`torchtrack.tracking.association.polarity.expected_polarity`).
        of_texture: whether events on texture are expected to say which side of it is the darker one.
    """
    silhouette, crease, texture = (contours.kind == int(kind) for kind in (ContourKind.SMOOTH, ContourKind.CREASE, ContourKind.TEXTURE))
    oriented, expected = silhouette | crease, (texture & of_texture).to(contours.pixels.dtype)
    if polarity is not None:
        expected = torch.where(oriented, polarity.gather(1, octant(contours.normals)), expected)
    marks = torch.stack([silhouette.to(expected.dtype), oriented.to(expected.dtype), expected], -1)
    values = (contours.points_obj, contours.normals, index.pixels, marks)
    return ContourTable(torch.cat([value.transpose(1, 2) for value in values], 1), index, ((silhouette | texture) & contours.mask).any(1))


@dataclass(frozen=True)
class Gate:
    """How far from contours observations are matched, in one round.

    Args:
        px: as configured.
        wider: by how much it, and all that is measured against contours, is wider for each object; by nothing where not given.
        subcell_lookup: objects whose contours are looked up between the cells of the index; none where not given.
    """

    px: float
    wider: Float[Tensor, "b"] | None = None
    subcell_lookup: Bool[Tensor, "b"] | None = None


def match_nearest(
    observations: Observations, table: ContourTable, place: Float[Tensor, "b n 2"], objects: MovingObjects, gate: Gate, config: TrackerConfig
) -> tuple[MatchesWithCues, Float[Tensor, "b n 2"]]:
    """Match each observation with its nearest contour point, as far as the gate; distances count along the normal.

    Args:
        table: of the contours, as they were indexed at some pose.
        place: where to look for each observation among the contours as indexed; returned anew for the next round.
        objects: at the current poses; a velocity of zero switches motion compensation off.
    """
    wider = torch.ones_like(place[:, 0, 0]) if gate.wider is None else gate.wider
    nearest_index = table.index.look_up(place, gate.subcell_lookup)
    points_obj, normals, indexed, silhouette, oriented, expected = table.take(contour := nearest_index.clamp(min=0))
    pixels, velocity = objects.show(points_obj)
    dark = observations.polarity * leading_side(vecdot(normals, velocity))
    carried = torch.addcmul(observations.pixels, velocity, observations.age_s[..., None])
    targets = torch.addcmul(carried, normals, (dark * dark_shift_px(silhouette, config))[..., None], value=-1)
    difference = pixels - targets
    near = observations.mask & (nearest_index >= 0)
    matched = near & (vecdot(difference, difference) < (gate.px * wider)[:, None].square())
    offsets = vecdot(difference, normals) / wider[:, None]
    as_expected, dark = agreeing(dark * expected), dark * oriented
    weights, around = match_weights(offsets, targets, near, dark, as_expected, config.association)
    cues = near, as_expected, dark, effective_weight(around, silhouette, config)
    matches = MatchesWithCues(contour, matched, weights, observations.age_s, points_obj, targets, normals, offsets, *cues)
    # Without the dark shift: between edges that lie close, it would make a choice confirm itself.
    return matches, torch.where(matched[..., None], carried - (pixels - indexed), place)
