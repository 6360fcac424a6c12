"""The objects that are handled as one batch: their models, cameras and streams, and their contours at any poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.padded import repeated
from torchtrack.object_model.contour_source import ContourKind, ContourModel
from torchtrack.tracking.contours.depth_buffer import Scene
from torchtrack.tracking.contours.points import Contours, assemble, joined
from torchtrack.tracking.contours.sampling import mesh_contours
from torchtrack.tracking.contours.splat import splat_contours
from torchtrack.tracking.contours.visibility import remove_hidden


@dataclass(frozen=True)
class LearnedPoints:
    """Contour points that were learned on the surface of each object.

    Args:
        points_obj: the points (m).
        tangents_obj: unit directions of the contour there.
        mask: which of them count.
    """

    points_obj: Float[Tensor, "b n 3"]
    tangents_obj: Float[Tensor, "b n 3"]
    mask: Bool[Tensor, "b n"]

    def contours(self, T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"]) -> Contours:
        """The points as contours at given poses, hidden ones included."""
        kind = torch.full(self.mask.shape, int(ContourKind.LEARNED), device=self.mask.device)
        return assemble(self.points_obj, self.tangents_obj, kind, self.mask, T_cam_obj, intrinsics)


@dataclass(frozen=True)
class ObjectBatch:
    """What does not change of the objects.

    Args:
        models: the distinct models, with the objects that have each.
        intrinsics: ``[fx, fy, cx, cy]`` of each object's camera.
        centre_obj: centre of each object (m).
        half_extent: from there to the sides of each object's bounding box, along the axes of its frame (m).
        diameter_m: diameter of each object.
        stream_index: the stream that each object is seen in.
        image_sizes: height and width of the image that each object is seen in (px).
        image_shape: streams, height and width of the largest image.
        shared: whether any stream has more than one object.
        learned: contour points beside those of the models; none when not given.
        polarity: the darker side expected of contours, by the octant that they face (:mod:`tracking.association.polarity`); nothing when not given.
    """

    models: Sequence[ContourModel]
    intrinsics: Float[Tensor, "b 4"]
    centre_obj: Float[Tensor, "b 3"]
    half_extent: Float[Tensor, "b 3"]
    diameter_m: Float[Tensor, "b"]
    stream_index: Int[Tensor, "b"]
    image_sizes: Int[Tensor, "b 2"]
    image_shape: tuple[int, int, int]
    shared: bool
    learned: LearnedPoints | None = None
    polarity: Float[Tensor, "b 8"] | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the largest image (px)."""
        return self.image_shape[1:]

    def depth_m(self, T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b"]:
        """Depth of each object's centre, at least what the camera can see (m)."""
        # Of the rotation, only the row that tells the depth: this is asked for in every window.
        return (vecdot(T_cam_obj[:, 2, :3], self.centre_obj) + T_cam_obj[:, 2, 3]).clamp(min=MIN_DEPTH_M)

    def px_per_m(self, T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b"]:
        """How far each object moves in the image when it moves by a metre across it (px)."""
        return self.intrinsics[:, 0] / self.depth_m(T_cam_obj)

    def size_px(self, T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b"]:
        """Diameter of each object in the image, at the depth of its centre (px)."""
        return self.diameter_m * self.intrinsics[:, 0] / self.depth_m(T_cam_obj)

    def contours(self, T_cam_obj: Float[Tensor, "b 4 4"], config: ContourConfig) -> Contours:
        """Visible contours at given poses."""
        if config.source == "splat":
            return splat_contours(self.models, T_cam_obj, self.intrinsics, config)
        return self._visible_with_learned(mesh_contours(self.models, T_cam_obj, self.intrinsics, config), T_cam_obj, config)

    def _visible_with_learned(self, contours: Contours, T_cam_obj: Tensor, config: ContourConfig) -> Contours:
        """Contours of the models joined with those that were learned, without hidden parts."""
        if self.learned is not None:
            contours = joined(contours, self.learned.contours(T_cam_obj, self.intrinsics))
        return self.visible(contours, T_cam_obj, config)

    def visible(self, contours: Contours, T_cam_obj: Float[Tensor, "b 4 4"], config: ContourConfig) -> Contours:
        """Contours without their hidden parts, where these are to be removed."""
        if not config.remove_hidden:
            return contours
        scene = Scene(self.models, T_cam_obj, self.intrinsics, self.stream_index, self.diameter_m, self.image_shape, self.shared)
        return remove_hidden(contours, scene)

    def rows(self, chosen: Int[Tensor, "k"]) -> "ObjectBatch":
        """Some of the objects; where they are read on the CPU."""
        places = [(model, torch.isin(chosen, model.members).nonzero()[:, 0]) for model in self.models]
        models = [model.with_members(of_model, of_model.tolist()) for model, of_model in places if len(of_model)]
        own = self.intrinsics, self.centre_obj, self.half_extent, self.diameter_m, self.stream_index, self.image_sizes
        intrinsics, centre_obj, half_extent, diameter_m, stream_index, sizes = (value[chosen] for value in own)
        learned = None if self.learned is None else LearnedPoints(*(value[chosen] for value in vars(self.learned).values()))
        polarity = None if self.polarity is None else self.polarity[chosen]
        shape, shared = self.image_shape, self.shared
        return ObjectBatch(models, intrinsics, centre_obj, half_extent, diameter_m, stream_index, sizes, shape, shared, learned, polarity)

    def copies(self, numbers: Sequence[int], count: int = 1) -> "ObjectBatch":
        """Some objects, each ``count`` times in turn and in a stream of its own: copies do not hide one another."""
        streams = torch.arange(len(numbers) * count, device=self.stream_index.device)
        places = [(model, [row for row, number in enumerate(numbers) if number in model.numbers]) for model in self.models]
        models = [model.with_members(*_copied(streams, rows, count)) for model, rows in places if rows]
        own = self.intrinsics, self.centre_obj, self.half_extent, self.diameter_m
        intrinsics, centre_obj, half_extent, diameter_m = (copied_rows(value, numbers, count) for value in own)
        learned = None if self.learned is None else LearnedPoints(*(copied_rows(value, numbers, count) for value in vars(self.learned).values()))
        polarity = None if self.polarity is None else copied_rows(self.polarity, numbers, count)
        sizes, shape = copied_rows(self.image_sizes, numbers, count), (len(streams), *self.image_size)
        return ObjectBatch(models, intrinsics, centre_obj, half_extent, diameter_m, streams, sizes, shape, False, learned, polarity)


def copied_rows(values: Shaped[Tensor, "b *c"], numbers: Sequence[int], count: int = 1) -> Shaped[Tensor, "n *c"]:
    """Some rows of a tensor, each ``count`` times in turn; a single one without a copy, and all of them once as they are."""
    if len(numbers) == 1:
        values = values[numbers[0] : numbers[0] + 1]
    elif list(numbers) != list(range(len(values))):
        # No index is made of numbers, for which a GPU would be waited for.
        values = torch.cat([values[number : number + 1] for number in numbers])
    return repeated(values, len(numbers) * count)


def _copied(streams: Int[Tensor, "n"], rows: Sequence[int], count: int) -> tuple[Int[Tensor, "k"], list[int]]:
    """The streams of the copies of some rows, and their numbers."""
    numbers = [number for row in rows for number in range(row * count, (row + 1) * count)]
    return torch.cat([streams[row * count : (row + 1) * count] for row in rows]), numbers
