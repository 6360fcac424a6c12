"""The object model that the tracker works with."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.errors import ModelError
from torchtrack.object_model.colour_edges import colour_edges
from torchtrack.object_model.loading import MESH_SUFFIXES, check_file, join_parts, load_parts, mesh_parts, place_part
from torchtrack.object_model.mesh_edges import EdgeTable, contour_edges
from torchtrack.object_model.notices import tell
from torchtrack.object_model.placement import Placement
from torchtrack.object_model.polylines import POLYLINE_SUFFIXES, as_polylines, has_obj_lines, read_polylines, segments_of
from torchtrack.object_model.sampling import sample_surface
from torchtrack.object_model.settings import ModelSettings, Unit
from torchtrack.object_model.surface import Surface, surface_from_parts
from torchtrack.object_model.surface_points import NO_POINTS, SurfacePoints, join_points, thin_out
from torchtrack.object_model.texture_edges import texture_edges, why_no_edges
from torchtrack.object_model.winding import turn_outwards

# Points on texture edges nearer than this fraction of the diameter see the same pixels.
_SPACING_FRACTION = 0.0025
_COLOUR_PIXELS = 4


@dataclass(frozen=True, eq=False, repr=False)
class ObjectModel:
    """Shape and print of one object: float32 tensors on the CPU, in metres, in the object's frame.

    Attributes:
        name: for messages and files.
        centre: of the bounding box.
        half_extent: from there to its sides, along the axes.
        diameter_m: its diagonal.
        edge_points: end points of the mesh edges that can ever be a contour, or are a crease.
        edge_normals: unit outward normals of the two faces beside each; ``(n, -n)`` at a border.
        edge_is_crease: bent by more than the crease angle: to be drawn whenever one of its faces is in front.
        texture_points: points on edges of the texture or the colours, evenly spaced along them.
        texture_tangents: unit, along the edge; the brighter side is along ``cross(normal, tangent)``.
        texture_normals: unit outward normals of the surface there.
        segments: line segments given by the user, always visible unless hidden.
        surface_points, surface_normals: uniform samples of the surface.
        triangles: corners of every face, the outside seen anticlockwise.
        mesh: the mesh in metres with its textures, for drawing and export; ``None`` for polylines.
    """

    name: str
    centre: Float[Tensor, "3"]
    half_extent: Float[Tensor, "3"]
    diameter_m: float
    edge_points: Float[Tensor, "e 2 3"]
    edge_normals: Float[Tensor, "e 2 3"]
    edge_is_crease: Bool[Tensor, " e"]
    texture_points: Float[Tensor, "q 3"]
    texture_tangents: Float[Tensor, "q 3"]
    texture_normals: Float[Tensor, "q 3"]
    segments: Float[Tensor, "l 2 3"]
    surface_points: Float[Tensor, "n 3"]
    surface_normals: Float[Tensor, "n 3"]
    triangles: Float[Tensor, "f 3 3"]
    mesh: trimesh.Trimesh | None

    @property
    def extent_points(self) -> Float[Tensor, "n 3"]:
        """Points all over it: the samples of its surface, or the ends of its segments where it has none."""
        return self.surface_points if len(self.surface_points) else self.segments.reshape(-1, 3)

    def __repr__(self) -> str:
        counted = {"edges": self.edge_points, "texture points": self.texture_points, "segments": self.segments, "faces": self.triangles}
        parts = ", ".join(f"{len(values)} {name}" for name, values in counted.items() if len(values))
        return f"ObjectModel('{self.name}', diameter {self.diameter_m:.4g} m, {parts})"

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        *,
        name: str | None = None,
        unit: Unit = "m",
        scale: float = 1.0,
        centre: bool = False,
        settings: ModelSettings | None = None,
    ) -> "ObjectModel":
        """A model from a PLY, OBJ, STL, GLB, glTF or OFF mesh, or from polylines (JSON, or OBJ with lines and no faces).

        Args:
            path: the file.
            name: the object's name; the file's, when not given.
            unit: the unit of the file's numbers (glTF is always in metres).
            scale: the model is enlarged by this.
            centre: the middle of its bounding box becomes the origin of the object's frame.
            settings: how edges and samples are taken.

        Raises:
            MissingFileError, UnknownFormatError: if the file is not there, or is of another kind.
            ModelError: if it cannot be read, is empty, not finite, or of a size that no tracked object has.
        """
        path = check_file(path, tuple(dict.fromkeys(MESH_SUFFIXES + POLYLINE_SUFFIXES)))
        try:
            if path.suffix.lower() == ".json" or (path.suffix.lower() == ".obj" and has_obj_lines(path)):
                return cls.from_polylines(path, name=name, unit=unit, scale=scale, centre=centre)
            return cls.from_mesh(load_parts(path), name=name or path.stem, unit=unit, scale=scale, centre=centre, settings=settings)
        except ModelError as error:
            if str(path) in str(error):
                raise
            raise ModelError(f"the object model '{path}' cannot be used: {error}") from error

    @classmethod
    def from_mesh(
        cls,
        mesh: trimesh.Trimesh | trimesh.Scene | Iterable[trimesh.Trimesh],
        *,
        name: str = "object",
        unit: Unit = "m",
        scale: float = 1.0,
        centre: bool = False,
        settings: ModelSettings | None = None,
    ) -> "ObjectModel":
        """A model from a mesh, a scene, or meshes that make up one object; they are not changed. Arguments are those of :meth:`from_file`.

        Warns (:class:`~torchtrack.errors.TorchtrackWarning`) when faces point inwards and are flipped.

        Raises:
            ModelError: if there are no faces, or as :meth:`from_file`.
        """
        settings = settings or ModelSettings()
        parts = mesh_parts(mesh, name)
        if not parts:
            raise ModelError(f"'{name}' has no triangles: the tracker needs a surface. Give a triangle mesh, or lines with from_polylines.")
        factor, origin = Placement(unit, scale, centre).metres(np.concatenate([part.vertices for part in parts]), name)
        for part in parts:
            place_part(part, factor, origin)
        surface, table, outwards = turn_outwards(surface_from_parts(parts), name)
        edges = contour_edges(surface, table, settings.crease_angle_deg, drop_concave=outwards)
        printed = _print_edges(surface, table, settings, name)
        points, normals = sample_surface(surface, settings.surface_point_count)
        return replace(
            cls._bare(name, surface.vertices[np.unique(surface.faces)]),
            edge_points=_tensor(edges.points),
            edge_normals=_tensor(edges.normals),
            edge_is_crease=torch.from_numpy(edges.is_crease),
            texture_points=_tensor(printed.points),
            texture_tangents=_tensor(printed.tangents),
            texture_normals=_tensor(printed.normals),
            surface_points=_tensor(points),
            surface_normals=_tensor(normals),
            triangles=_tensor(surface.corners),
            mesh=_drawable(parts, surface),
        )

    @classmethod
    def from_polylines(
        cls,
        source: str | Path | Sequence[Sequence[Sequence[float | int]]] | Sequence[np.ndarray] | np.ndarray,
        *,
        name: str | None = None,
        unit: Unit = "m",
        scale: float = 1.0,
        centre: bool = False,
    ) -> "ObjectModel":
        """A model of line segments alone: a printed pattern, a book's page.

        Args:
            source: a file (see :mod:`torchtrack.object_model.polylines`), or a list of polylines ``[n, 3]``.
            name: the object's name; the file's, when not given.
            unit: the unit of the numbers, unless the file states its own.
            scale, centre: as in :meth:`from_file`.

        Raises:
            MissingFileError, UnknownFormatError, ModelError: as :meth:`from_file`.
        """
        stated: str | None = None
        if isinstance(source, str | Path):
            polylines, stated = read_polylines(source)
            name = name or Path(source).stem
        else:
            polylines = as_polylines(source)
        name = name or "polylines"
        segments = segments_of(polylines)
        if len(segments) == 0:
            raise ModelError(f"'{name}' has no line segments. Give at least one polyline of two different points.")
        factor, origin = Placement(stated or unit, scale, centre).metres(segments.reshape(-1, 3), name)
        points = segments.reshape(-1, 3) * factor - origin
        return replace(cls._bare(name, points), segments=_tensor(points.reshape(-1, 2, 3)))

    @classmethod
    def _bare(cls, name: str, extent: np.ndarray) -> "ObjectModel":
        """A model with nothing on it yet, whose bounding box is that of ``extent [n, 3]``."""
        low, high = extent.min(0), extent.max(0)
        points, pairs = _tensor(np.zeros((0, 3))), _tensor(np.zeros((0, 2, 3)))
        return cls(
            name=name,
            centre=_tensor((low + high) / 2),
            half_extent=_tensor((high - low) / 2),
            diameter_m=float(np.linalg.norm(high - low)),
            edge_points=pairs,
            edge_normals=pairs,
            edge_is_crease=torch.zeros(0, dtype=torch.bool),
            texture_points=points,
            texture_tangents=points,
            texture_normals=points,
            segments=pairs,
            surface_points=points,
            surface_normals=points,
            triangles=_tensor(np.zeros((0, 3, 3))),
            mesh=None,
        )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _print_edges(surface: Surface, table: EdgeTable, settings: ModelSettings, name: str) -> SurfacePoints:
    """Evenly spaced points on the edges of textures and colours; warns of a texture that gives none."""
    spacing_m = _SPACING_FRACTION * surface.diameter
    if settings.max_texture_points == 0:
        return NO_POINTS
    printed = texture_edges(surface, table, settings.texture_contrast)
    for number, printed_edges in enumerate(printed):
        # A texture of few pixels is a colour: trimesh gives one to every part without a material.
        if len(printed_edges.points) == 0 and surface.textures[number].size > _COLOUR_PIXELS:
            which = f"texture {number + 1} of {len(printed)}" if len(printed) > 1 else "the texture"
            tell(
                f"{which} of '{name}' gives no edges, so that only the geometry is used: {why_no_edges(surface, number, settings.texture_contrast)}."
            )
    dense = join_points([join_points(printed), colour_edges(surface, table, settings.texture_contrast, spacing_m / 2)])
    return thin_out(dense, spacing_m, settings.max_texture_points)


def _drawable(parts: list[trimesh.Trimesh], surface: Surface) -> trimesh.Trimesh:
    """One mesh of the parts, with those faces flipped that the surface has flipped."""
    mesh = join_parts(parts)
    outward = surface.normals
    inverted = surface.source_face[(mesh.face_normals[surface.source_face] * outward).sum(1) < 0]
    if len(inverted):
        faces = mesh.faces.copy()
        faces[inverted] = faces[inverted, ::-1]
        mesh.faces = faces
    return mesh
