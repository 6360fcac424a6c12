"""What can be said of a model's file before it is tracked: size, unit, origin, surface, edges, texture, symmetries.

In goes the path of a mesh or of polylines, out comes a :class:`ModelReport` with the model as the tracker would have it.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from torchtrack.errors import TorchtrackWarning
from torchtrack.object_model.loading import MESH_SUFFIXES, check_file, load_parts
from torchtrack.object_model.mesh_edges import edge_table
from torchtrack.object_model.model import ObjectModel
from torchtrack.object_model.placement import plausible_units
from torchtrack.object_model.polylines import POLYLINE_SUFFIXES, has_obj_lines, read_polylines, segments_of
from torchtrack.object_model.settings import METRES_PER_UNIT, Unit
from torchtrack.object_model.surface import surface_from_parts
from torchtrack.object_model.symmetry import RevolutionAxis, mirrored_across, revolution_axis, symmetry_planes, turning_axis
from torchtrack.object_model.textures import texture_image
from torchtrack.object_model.winding import turn_outwards

# Most tracked objects are of this size (m): a unit that gives it is more likely than one that is only possible.
_USUAL_M = (0.03, 1.0)
# Planes whose normals have a larger cosine are one.
_SAME_COSINE = 0.98
# Units by how often models come in them.
_ORDER: tuple[Unit, ...] = ("m", "mm", "cm", "inch")


@dataclass(frozen=True)
class SurfaceReport:
    """The surface of a mesh.

    Args:
        parts: meshes in the file.
        faces: triangles that are used.
        dropped_faces: triangles without area, or stored twice.
        vertices: distinct positions.
        open_edges: edges of one face, or of more than two; a watertight surface has none.
        contrary_edges: edges whose two faces are wound against each other, in the file.
        flipped_faces: faces that were turned to show the outside.
        textures: width and height of each image (px).
    """

    parts: int
    faces: int
    dropped_faces: int
    vertices: int
    open_edges: int
    contrary_edges: int
    flipped_faces: int
    textures: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class ModelReport:
    """What is known of a model.

    Args:
        model: as the tracker would have it.
        size: of its bounding box, in the numbers of the file.
        middle: of its bounding box, in the numbers of the file.
        unit: the unit that the model was made with.
        is_assumed: nobody said the unit.
        units: all units in which the model may be a tracked object.
        surface: of a mesh; None for polylines.
        revolution: the axis that it can be turned about unseen; None where there is none.
        turning: the axis that most of it can be turned about unseen; None where there is none.
        planes: unit normals of its planes of symmetry ``[k, 3]``.
        notes: warnings that reading it gave.
    """

    model: ObjectModel
    size: Float[ndarray, "3"]
    middle: Float[ndarray, "3"]
    unit: str
    is_assumed: bool
    units: tuple[str, ...]
    surface: SurfaceReport | None
    revolution: RevolutionAxis | None
    turning: RevolutionAxis | None
    planes: Float[ndarray, "k 3"]
    notes: tuple[str, ...]

    @property
    def off_centre(self) -> float:
        """Distance of the origin of the file from the middle of the model (diameters)."""
        return float(np.linalg.norm(self.middle) / np.linalg.norm(self.size))

    @property
    def creases(self) -> int:
        """Edges that always show."""
        return int(self.model.edge_is_crease.sum())

    @property
    def silhouettes(self) -> int:
        """Edges that show where the surface turns away."""
        return len(self.model.edge_is_crease) - self.creases


def describe_model(path: str | Path, unit: Unit | None = None, scale: float = 1.0, *, centre: bool = False) -> ModelReport:
    """Read a model and describe it.

    Args:
        path: a mesh, or polylines.
        unit: of its numbers; the likeliest when not given.
        scale: the model is enlarged by this.
        centre: the middle of its bounding box is its origin.

    Raises:
        MissingFileError, UnknownFormatError, ModelError, LimitError: as :meth:`ObjectModel.from_file`.
    """
    path = check_file(path, tuple(dict.fromkeys(MESH_SUFFIXES + POLYLINE_SUFFIXES)))
    with warnings.catch_warnings():
        # The model itself warns of the same once more.
        warnings.simplefilter("ignore", TorchtrackWarning)
        points, surface, stated = _looked_at(path)
    size = np.ptp(points, axis=0)
    with np.errstate(all="ignore"):
        diameter = float(np.linalg.norm(size)) * scale
    chosen = unit or stated or likely_unit(diameter)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TorchtrackWarning)
        model = ObjectModel.from_file(path, unit=chosen, scale=scale, centre=centre)
    return ModelReport(
        model=model,
        size=size,
        middle=(points.min(0) + points.max(0)) / 2,
        unit=stated or chosen,
        is_assumed=unit is None and stated is None,
        units=tuple(plausible_units(diameter)),
        surface=surface,
        revolution=revolution_axis(model),
        turning=turning_axis(model),
        planes=_planes(model),
        notes=tuple(dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, TorchtrackWarning))),
    )


def _planes(model: ObjectModel) -> Float[ndarray, "k 3"]:
    """Unit normals of planes of symmetry: across the axes of the frame, and across principal axes that are none of these."""
    of_frame, principal = mirrored_across(model, torch.eye(3, dtype=torch.float64)), symmetry_planes(model)[1]
    other = ((principal @ of_frame.mT).abs() < _SAME_COSINE).all(1) if len(of_frame) else torch.ones(len(principal), dtype=torch.bool)
    return torch.cat([of_frame, principal[other]]).numpy()


def likely_unit(diameter: float) -> Unit:
    """The unit in which a model so many of them across is of the usual size of an object; else one in which it is possible; else metres."""
    usual = [unit for unit in _ORDER if _USUAL_M[0] <= diameter * METRES_PER_UNIT[unit] <= _USUAL_M[1]]
    possible = [unit for unit in _ORDER if unit in plausible_units(diameter)]
    return [*usual, *possible, "m"][0]


def _looked_at(path: Path) -> tuple[Float[ndarray, "n 3"], SurfaceReport | None, Unit | None]:
    """Points in the numbers of the file, its surface, and the unit that it states itself."""
    if path.suffix.lower() == ".json" or (path.suffix.lower() == ".obj" and has_obj_lines(path)):
        polylines, stated = read_polylines(path)
        segments = segments_of(polylines).reshape(-1, 3)
        # Of no segments, or an unknown unit, the model says what is wrong.
        known = next((unit for unit in _ORDER if unit == stated), None)
        return segments if len(segments) else np.zeros((1, 3)), None, known
    parts = load_parts(path)
    surface = surface_from_parts(parts)
    contrary = int((~edge_table(surface).consistent).sum())
    outward, table, _ = turn_outwards(surface, path.stem)
    images = {id(image): (image.width, image.height) for image in map(texture_image, parts) if image is not None}
    report = SurfaceReport(
        parts=len(parts),
        faces=len(surface.faces),
        dropped_faces=sum(len(part.faces) for part in parts) - len(surface.faces),
        vertices=len(np.unique(surface.faces)),
        open_edges=int((~table.paired).sum()),
        contrary_edges=contrary,
        flipped_faces=int((outward.faces != surface.faces).any(1).sum()),
        textures=tuple(images.values()),
    )
    return surface.vertices[np.unique(surface.faces)], report, "m" if path.suffix.lower() in (".glb", ".gltf") else None
