"""Faces turned to the outside.

Which edges are contours is decided by the sign of the faces' normals, so a mesh that is inside out, or partly so, would
be tracked by the wrong edges without a word. Here it is set right where that is possible, and said.
"""

import warnings

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from torchtrack.errors import TorchtrackWarning
from torchtrack.object_model.mesh_edges import EdgeTable, edge_table
from torchtrack.object_model.surface import Surface

# Of an open mesh, the share of its cone volumes that must agree before its orientation is believed.
_OUTWARD_SHARE = 0.5


def turn_outwards(surface: Surface, name: str) -> tuple[Surface, EdgeTable, bool]:
    """The surface with its faces turned outwards, its edges, and whether "outwards" is certain.

    Warns (:class:`TorchtrackWarning`) when faces had to be turned, or contradict each other beyond repair.
    """
    table = edge_table(surface)
    if not table.consistent.all():
        surface = _make_consistent(surface, table, name)
        table = edge_table(surface)
    inverted = _inverted_faces(surface, table)
    if inverted.any():
        _warn(f"{inverted.sum()} of {len(inverted)} faces of '{name}' point inwards; they were flipped.")
        surface = surface.flip(inverted)
        table = edge_table(surface)
    cones = _cone_volumes(surface, np.zeros(len(surface.faces), dtype=np.int64))
    closed = bool(table.paired.all())
    certain = bool(table.consistent.all() and (closed or cones.sum() > _OUTWARD_SHARE * np.abs(cones).sum()))
    return surface, table, certain


def _warn(problem: str) -> None:
    warnings.warn(
        f"{problem} To silence this, recalculate the normals to the outside in a mesh editor and export again.", TorchtrackWarning, stacklevel=5
    )


def _components(table: EdgeTable, face_count: int) -> np.ndarray:
    """Number of the connected piece of every face."""
    a, b = table.faces[table.paired].T
    return connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(face_count, face_count)), directed=False)[1]


def _make_consistent(surface: Surface, table: EdgeTable, name: str) -> Surface:
    """Neighbouring faces made to show the same side, as far as the surface has two sides."""
    parity = _parity(table, len(surface.faces))
    component = _components(table, len(surface.faces))
    # Keep the side that most faces of a piece show.
    minority = np.bincount(component, weights=parity) * 2 > np.bincount(component)
    surface = surface.flip(parity ^ minority[component])
    left = (~edge_table(surface).consistent).sum()
    if left:
        _warn(f"the faces of '{name}' contradict each other about inside and outside along {left} edges, and no turning mends it.")
    else:
        _warn(f"{(parity ^ minority[component]).sum()} of {len(parity)} faces of '{name}' were wound against their neighbours; they were flipped.")
    return surface


def _parity(table: EdgeTable, face_count: int) -> np.ndarray:
    """``[F]`` true for faces wound against the first face of their piece."""
    a, b = table.faces[table.paired].T
    against = ~table.consistent[table.paired]
    # One search for all pieces, from a root that is joined to the first face of each: a search a piece takes the square of their number.
    seeds = np.unique(_components(table, face_count), return_index=True)[1]
    root = np.full(len(seeds), face_count)
    weights = np.r_[np.where(against, 2, 1), np.ones(len(seeds), dtype=np.int64)]
    rows, columns = np.r_[a, root], np.r_[b, seeds]
    graph = coo_matrix((np.r_[weights, weights], (np.r_[rows, columns], np.r_[columns, rows])), shape=(face_count + 1, face_count + 1)).tocsr()
    order, parent = breadth_first_order(graph, face_count, directed=False)
    order = order[1:]
    steps = np.asarray(graph[parent[order], order]).reshape(-1) == 2
    parity = [False] * (face_count + 1)
    for face, before, step in zip(order.tolist(), parent[order].tolist(), steps.tolist(), strict=True):
        parity[face] = parity[before] ^ step
    return np.array(parity[:-1])


def _cone_volumes(surface: Surface, component: np.ndarray) -> np.ndarray:
    """Signed volume ``[F]`` between each face and the centre of its piece."""
    corners = surface.corners
    count = np.bincount(component)
    centre = np.stack([np.bincount(component, weights=axis) / count for axis in corners.mean(1).T], 1)
    a, b, c = (corners - centre[component][:, None]).transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum(1) / 6


def _inverted_faces(surface: Surface, table: EdgeTable) -> np.ndarray:
    """``[F]`` faces of closed pieces with a negative volume; or all, of an open mesh that is clearly inside out."""
    component = _components(table, len(surface.faces))
    is_open = np.zeros(component.max() + 1, dtype=bool)
    is_open[component[table.faces[~table.paired, 0]]] = True
    volume = np.bincount(component, weights=_cone_volumes(surface, component))
    inverted = (volume < 0) & ~is_open
    whole = _cone_volumes(surface, np.zeros_like(component))
    if is_open.any() and whole.sum() < -_OUTWARD_SHARE * np.abs(whole).sum():
        inverted |= is_open
    return inverted[component]
